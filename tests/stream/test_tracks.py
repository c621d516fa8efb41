"""Identities from frame to frame, on a row whose fruit and camera are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from cucumbervision.arrays import Array
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance
from cucumbervision.methods.result import INTERVAL_Z, Length, LengthDefinition, LengthKind
from cucumbervision.stream.tracks import FIXED, Sighting, Track, Tracker, TrackLength, sighting_of

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


HERE, THERE = np.array([0.0, 0.0, 0.5]), np.array([0.2, 0.0, 0.5])
SCALE = 0.01
OWN_SD = 0.02


def length(value_m: float, sd: float = np.hypot(OWN_SD, SCALE), shift: float = 0.0) -> Length:
    """A length whose interval is that of a relative standard deviation."""
    low, high = value_m * np.exp(shift + INTERVAL_Z * sd * np.array([-1, 1]))
    return Length(value_m, LengthDefinition.THREAD, float(low), float(high))


def relative_sd(one: Length) -> float:
    return one.relative_sd or 0.0


def after(*frames: tuple[Length, Array], **how: bool) -> tuple[TrackLength, Length]:
    """Return a track after frames of the whole fruit, and its length."""
    track = TrackLength()
    for frame, place in frames:
        track.add(frame, place, **how)
    assert track.length is not None
    return track, track.length


def test_one_frame_is_the_measurement_itself() -> None:
    given = length(0.25, shift=-0.03)  # an interval beside the length: the method reads long
    _, known = after((given, HERE))
    assert (known.value_m, known.low_m, known.high_m) == pytest.approx(
        (0.25, given.low_m, given.high_m)
    )


def test_frames_from_one_place_leave_the_fixed_part() -> None:
    track, known = after(*[(length(0.25), HERE)] * 1000)
    # 1000 frames: all but the fixed part of the own variance is gone, and the scale's stays.
    left = OWN_SD**2 * (FIXED + (1 - FIXED) / 1000) + SCALE**2
    assert relative_sd(known) == pytest.approx(np.sqrt(left), rel=1e-6)
    assert (track.frames, len(track.places)) == (1000, 1)


def test_a_second_place_halves_the_part_that_views_do_not_share() -> None:
    track, known = after((length(0.25), HERE), (length(0.25), THERE), scale_known=False)
    # SHARED is a half: 0.5 + 0.5 / 2 of the own variance.
    assert relative_sd(known) == pytest.approx(np.sqrt(0.75 * OWN_SD**2 + SCALE**2))
    assert len(track.places) == 2


def test_places_that_disagree_widen_it() -> None:
    _, agreed = after((length(0.25), HERE), (length(0.25), THERE))
    _, apart = after((length(0.25), HERE), (length(0.30), THERE))
    assert apart.value_m == pytest.approx(np.sqrt(0.25 * 0.30))
    assert relative_sd(apart) > 3 * relative_sd(agreed)


def test_an_outline_that_flickers_widens_its_own_place() -> None:
    _, calm = after(*[(length(0.25), HERE)] * 10)
    _, restless = after(*[(length(0.25 * factor), HERE) for factor in (0.9, 1.1) * 5])
    assert relative_sd(restless) > 1.5 * relative_sd(calm)


def test_a_known_scale_is_not_added() -> None:
    _, known = after((length(0.25, OWN_SD), HERE), scale_known=True)
    assert relative_sd(known) == pytest.approx(OWN_SD)


def test_lower_bounds_count_until_the_whole_fruit_is_seen() -> None:
    track = TrackLength()
    for value in (0.10, 0.18, 0.14):
        track.add(length(value), HERE, partial=True)
    assert (track.length, track.at_least_m) == (None, 0.18)
    track.add(length(0.25), HERE)
    assert track.length is not None
    assert track.length.value_m == pytest.approx(0.25)


def test_a_tube_goes_before_raw_lengths_which_are_another_thing() -> None:
    raw = Length(0.21, LengthKind.SURFACE_ARC, 0.20, 0.24, LengthDefinition.CENTRELINE)
    track, known = after((raw, HERE), (length(0.25), HERE), (raw, HERE))
    assert known.value_m == pytest.approx(0.25)
    assert (track.frames, track.kind) == (1, LengthDefinition.THREAD)


def test_a_length_without_an_interval_is_unsure() -> None:
    _, known = after((Length(0.25, LengthDefinition.THREAD), HERE))
    assert relative_sd(known) == pytest.approx(0.08, rel=0.01)
