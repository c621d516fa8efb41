"""Identities from frame to frame, on a row whose fruit and camera are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from cucumbervision.arrays import Array
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance
from cucumbervision.stream.tracks import Sighting, Track, Tracker, sighting_of

CAMERA = Intrinsics(848, 480, 616.0, 616.0, 424.0, 240.0)


@dataclass
class Row:
    """Hanging boxes along a row; the camera walks beside them."""

    at_m: Array
    rng: np.random.Generator
    noise_m: float = 0.004

    def seen(self, camera_m: float) -> tuple[list[int], list[Sighting]]:
        """The fruit in the picture, in an order of their own each time."""
        names, views = [], []
        for k in self.rng.permutation(len(self.at_m)).tolist():
            place = self.at_m[k] - [camera_m, 0.0, 0.0]
            u, v = CAMERA.project([place])[0]
            if not 20 < u < 828:
                continue
            half = 616 / place[2] * np.array([0.02, 0.09])
            shape = (round(2 * half[1] / 4), round(2 * half[0] / 4))
            noisy = place + self.rng.normal(0, self.noise_m, 3) * [1, 1, 2]
            names.append(k)
            views.append(
                Sighting(noisy, round(v - half[1]), round(u - half[0]), np.ones(shape, bool))
            )
        return names, views


def numbers_of(tracks: list[Track]) -> list[int]:
    return [track.number for track in tracks]


def assigned(tracker: Tracker, views: list[Sighting], now_s: float) -> list[int]:
    return numbers_of(tracker.assign(views, CAMERA, now_s))


def walk(row: Row, speed_m_s: float, fps: float, frames: int) -> list[dict[int, int]]:
    tracker, found = Tracker(), []
    for k in range(frames):
        names, views = row.seen(speed_m_s * k / fps)
        numbers = assigned(tracker, views, k / fps)
        assert len(set(numbers)) == len(numbers)
        found.append(dict(zip(names, numbers, strict=True)))
    return found


def rows_of(seed: int, count: int, apart_m: float) -> Row:
    rng = np.random.default_rng(seed)
    along = np.cumsum(rng.uniform(0.7, 1.3, count) * apart_m) - 0.3
    up = rng.uniform(-0.06, 0.06, count)
    return Row(np.column_stack([along, up, rng.uniform(0.5, 0.7, count)]), rng)


@pytest.mark.parametrize(
    ("speed_m_s", "fps", "apart_m"),
    [
        (0.0, 15, 0.08),
        (0.3, 15, 0.08),
        # 10 cm between two frames, farther than a fruit is wide and than fruit hang apart.
        (0.5, 5, 0.09),
        (-0.5, 5, 0.09),
    ],
)
def test_a_walk_along_a_row_keeps_every_fruits_number(
    speed_m_s: float, fps: float, apart_m: float
) -> None:
    row = rows_of(3, 12, apart_m)
    numbers: dict[int, set[int]] = {}
    for frame in walk(row, speed_m_s, fps, 15):
        for fruit, number in frame.items():
            numbers.setdefault(fruit, set()).add(number)
    assert len(numbers) >= 5
    assert all(len(own) == 1 for own in numbers.values()), numbers
    assert len(set.union(*numbers.values())) == len(numbers)


def test_a_fruit_that_a_leaf_hides_comes_back_with_its_number() -> None:
    row, tracker = rows_of(1, 4, 0.12), Tracker(keep_s=1.0)
    numbers: dict[int, set[int]] = {}
    for k in range(16):
        names, views = row.seen(0.01 * k)
        kept = [j for j, name in enumerate(names) if not (name == 2 and 5 <= k < 10)]
        got = assigned(tracker, [views[j] for j in kept], k / 15)
        for j, number in zip(kept, got, strict=True):
            numbers.setdefault(names[j], set()).add(number)
    assert [len(own) for own in numbers.values()] == [1] * len(numbers)


def test_a_fruit_out_of_sight_for_too_long_is_another() -> None:
    tracker = Tracker(keep_s=1.0)
    view = Sighting(np.array([0.0, 0.0, 0.5]), 100, 100, np.ones((20, 5), bool))
    assert assigned(tracker, [view], 0.0) == [1]
    for at_s in (0.3, 0.6, 0.9):
        assert assigned(tracker, [], at_s) == []
    assert numbers_of(tracker.tracks) == [1]
    assert assigned(tracker, [view], 1.2) == [2]


def test_a_loaded_computer_that_takes_a_frame_in_three_seconds_keeps_every_number() -> None:
    row, tracker = rows_of(1, 2, 0.3), Tracker()
    pairs = set()
    for frame in range(20):
        names, views = row.seen(0.1)
        pairs |= set(zip(names, assigned(tracker, views, 3.0 * frame), strict=True))
    assert len(pairs) == 2


def test_a_clock_that_is_set_back_keeps_no_fruit_of_the_future() -> None:
    row = rows_of(6, 3, 0.2)
    tracker = Tracker()
    assigned(tracker, row.seen(0.1)[1], 3600.0)
    before = {*numbers_of(tracker.tracks)}
    assigned(tracker, row.seen(0.1)[1], 0.0)
    assert before
    assert not before & {*numbers_of(tracker.tracks)}


def test_time_that_stands_still_does_not_pile_up_fruit() -> None:
    row = rows_of(7, 220, 0.4)
    tracker = Tracker()
    for frame in range(400):  # every other shows another fruit
        assigned(tracker, row.seen(0.2 * frame)[1], 5.0)
    assert len(tracker.tracks) < 130


def test_without_depth_the_masks_tell() -> None:
    nowhere = np.full(3, np.nan)
    a = Sighting(nowhere, 100, 100, np.ones((20, 5), bool))
    b = Sighting(nowhere, 100, 300, np.ones((20, 5), bool))
    tracker = Tracker()
    assert assigned(tracker, [a, b], 0.0) == [1, 2]
    moved = Sighting(nowhere, 104, 304, np.ones((20, 5), bool))
    assert assigned(tracker, [moved, a], 0.1) == [2, 1]
    far = Sighting(nowhere, 100, 600, np.ones((20, 5), bool))
    assert assigned(tracker, [far], 0.2) == [3]


def test_the_middle_of_a_mask_lies_where_its_readings_are() -> None:
    depth_m = np.full((480, 848), 2.0, np.float32)
    depth_m[100:300, 400:440] = 0.5
    depth_m[100:120] = 0.0  # holes count nowhere
    mask = np.zeros((480, 848), bool)
    mask[100:300, 400:440] = True
    capture = Capture(np.zeros((480, 848, 3), np.uint8), depth_m, CAMERA, "a")
    box = np.array([399.5, 99.5, 439.5, 299.5])
    # The box's middle is (419.5, 199.5): (419.5 - 424) / 616 * 0.5, (199.5 - 240) / 616 * 0.5.
    expected = [-0.0036526, -0.0328734, 0.5]
    for instance in (Instance(box, mask=mask), Instance(box)):
        view = sighting_of(capture, instance)
        np.testing.assert_allclose(view.at_m, expected, atol=5e-4)
        assert view.outline.shape == (50, 10)
    depth_m[:] = 0.0
    assert np.isnan(sighting_of(capture, Instance(box, mask=mask)).at_m).all()
