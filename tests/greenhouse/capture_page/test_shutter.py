from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.greenhouse.conftest import add_one

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.raw_frames import FrameRing
from cucumbervision.capture.realsense import CameraConfig
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import InstancesError, StoreError
from cucumbervision.perception.registry import load_registry
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision_greenhouse.backend.camera_feed import FAR_S, REACH_S, CameraBurst, CameraFeed
from cucumbervision_greenhouse.backend.jobs import Job
from cucumbervision_greenhouse.backend.measuring import SharedMeasurer, measure_waiting
from cucumbervision_greenhouse.backend.replay_feed import Replay
from cucumbervision_greenhouse.capture_page.shutter import Press, Shutter
from cucumbervision_greenhouse.rounds.demonstration import DEMONSTRATION
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import Waiting, WaitingCaptures

WALK = key_of("walk")


@pytest.fixture
def waiting(tmp_path: Path) -> WaitingCaptures:
    return WaitingCaptures(tmp_path / "kept")


def emptied(folder: Path) -> FrameRing:
    """The ring of a folder, without frames."""
    for one in FrameRing(folder).frames():
        one.path.unlink()
    return FrameRing(folder)


def test_a_burst_lies_about_its_press_though_the_press_is_told_late(
    recording: Path, store: Store, waiting: WaitingCaptures, tmp_path: Path
) -> None:
    feed = CameraFeed(
        tmp_path / "frames", CameraConfig(playback=recording, warm_up=0, fps=15), paced=True
    )
    while feed.preview().state != "playing":
        time.sleep(0.01)  # until the test's own limit
    shutter = Shutter(store, waiting, lambda: None)
    until = time.monotonic() + 1.0
    while time.monotonic() < until:
        feed.preview()
        time.sleep(0.01)
    pressed_s = time.time() - 0.5  # the browser said so half a second late
    grabbed = feed.grab(5, pressed_s)
    assert isinstance(grabbed, CameraBurst)
    # At 15 frames a second four or five are near enough; a busy machine has fewer to give.
    assert 1 <= grabbed.capture().burst_size <= 5
    times = [one.at_s for one in grabbed.frames]
    assert times == sorted(times)
    # About the press, and none from when we were told.
    assert len(times) == 1 or grabbed.farthest_s <= REACH_S
    assert times[-1] < pressed_s + 0.5
    assert shutter.press(feed, 5, WALK, Stop("1", "left", 0.0), Press("a", time.time()))
    shutter.close()
    feed.close()
    (kept,) = waiting.captures()
    assert (kept.round_key, kept.stop.row) == (WALK, "1")
    assert 1 <= kept.load().burst_size <= 5


def test_quick_presses_are_each_a_stop_and_none_counts_twice(
    store: Store, waiting: WaitingCaptures
) -> None:
    replay, told = Replay(example_captures()), list[int]()
    shutter = Shutter(store, waiting, lambda: told.append(1))
    for number in "aabbc":
        shutter.press(replay, 1, WALK, Stop("1", "left", 0.0), Press(number, time.time()))
    shutter.close()
    assert len(told) == 3
    kept = waiting.captures()
    # Drawn captures: never the grower's round.
    assert {one.round_key for one in kept} == {DEMONSTRATION}
    assert [one.stop.step for one in kept] == [1, 2, 3]
    assert len({one.load().name for one in kept}) == 3


def test_two_browsers_never_give_one_place_to_two_stops(
    store: Store, waiting: WaitingCaptures
) -> None:
    replay, shutter = Replay(example_captures()), Shutter(store, waiting, lambda: None)
    places = [("a", 0.0), ("b", 0.5), ("c", 0.5), ("d", 0.0), ("e", 0.75)]
    for number, at_m in places:
        shutter.press(replay, 1, WALK, Stop("1", "left", at_m), Press(number, time.time()))
    shutter.press(replay, 1, WALK, Stop("1", "right", 0.5), Press("other side", time.time()))
    shutter.close()
    kept = [one.stop.position_m for one in waiting.captures()]
    # The third and fourth go on from the last, as far as the last two lie apart.
    assert kept == [0.0, 0.5, 1.0, 1.5, 0.75, 0.5]
    moved = [one.moved for one in shutter.pressed(WALK)]
    assert [one and one.position_m for one in moved] == [None, None, 1.0, 1.5, None, None]


def test_presses_that_are_told_late_together_keep_their_order(
    store: Store, waiting: WaitingCaptures
) -> None:
    replay, shutter = Replay(example_captures()), Shutter(store, waiting, lambda: None)
    now = time.time()
    for number, at_s in (("a", now), ("b", now + 0.001), ("c", now + 60)):
        shutter.press(replay, 1, WALK, Stop("1", "left", 0.0), Press(number, at_s))
    shutter.close()
    kept = waiting.captures()
    assert [one.stop.step for one in kept] == [1, 2, 3]
    assert all(now <= one.pressed_s < now + 60 for one in kept)


def test_presses_of_a_gap_each_get_the_picture_of_their_moment(
    recording: Path, store: Store, waiting: WaitingCaptures, tmp_path: Path
) -> None:
    feed = CameraFeed(
        tmp_path / "frames", CameraConfig(playback=recording, warm_up=0, fps=15), paced=True
    )
    while feed.preview().state != "playing":
        time.sleep(0.01)
    time.sleep(0.5)
    pressed_s = []
    for _ in range(3):  # nobody looks, and nothing reaches us
        pressed_s.append(time.time())
        time.sleep(1.0)
    shutter, stop = Shutter(store, waiting, lambda: None), Stop("1", "left", 0.0)
    for number, at_s in enumerate(pressed_s):
        grabbed = feed.grab(1, at_s)
        assert isinstance(grabbed, CameraBurst)
        grabbed.capture()
        assert grabbed.nearest_s < FAR_S
        assert shutter.press(feed, 1, WALK, stop, Press(str(number), at_s))
    shutter.close()
    feed.close()
    assert [one.pressed_s for one in waiting.captures()] == pytest.approx(pressed_s)


def test_a_late_press_gets_the_frame_before_it_where_that_one_is_nearer(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CameraFeed, "_begin_watched", lambda feed: None)
    feed = CameraFeed(tmp_path / "frames", CameraConfig(playback=recording, warm_up=0))
    capture, now = Replay(example_captures()).take(1, Stop()), time.time()
    ring = FrameRing(tmp_path / "frames")
    for ago_s in (4.0, 3.5, 3.0, 2.5):
        ring.write(capture, now - ago_s)
    for after_s, nearest_s in ((0.2, 0.2), (0.3, 0.2), (0.05, 0.05)):
        grabbed = feed.grab(1, now - 3.5 + after_s)
        assert len(grabbed.frames) == 1
        assert grabbed.nearest_s == pytest.approx(nearest_s, abs=1e-3)
    feed.close()


def test_a_press_between_frames_waits_for_the_next_and_takes_the_nearer(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CameraFeed, "_begin_watched", lambda feed: None)
    feed = CameraFeed(tmp_path / "frames", CameraConfig(playback=recording, warm_up=0, fps=15))
    capture, now = Replay(example_captures()).take(1, Stop()), time.time()
    for next_s, nearest_s in ((0.03, 0.03), (0.37, 0.04)):  # as it should come; from a slow camera
        ring = emptied(tmp_path / "frames")
        ring.write(capture, now - 0.04)
        grabbed = feed.grab(1, now)
        full = [grabbed.is_full]
        ring.write(capture, now + next_s)
        grabbed.look()
        assert [*full, grabbed.is_full] == [False, True]
        assert [abs(one.at_s - now) for one in grabbed.frames] == pytest.approx(
            [nearest_s], abs=1e-5
        )
    # The five nearest, however they lie about the press.
    ring = emptied(tmp_path / "frames")
    for after_s in (-0.14, -0.08, -0.03, -0.01, 0.05, 0.12):
        ring.write(capture, now + after_s)
    times = [one.at_s - now for one in feed.grab(5, now).frames]
    assert times == pytest.approx([-0.08, -0.03, -0.01, 0.05, 0.12], abs=1e-5)
    feed.close()


def test_a_press_whose_picture_is_gone_is_refused_and_told(
    recording: Path, store: Store, waiting: WaitingCaptures, tmp_path: Path
) -> None:
    stop, now = Stop("1", "left", 0.0), time.time()
    feed = CameraFeed(
        tmp_path / "frames", CameraConfig(playback=recording, warm_up=0, fps=15), paced=True
    )
    for feed_of in (feed, Replay(example_captures())):
        shutter = Shutter(store, waiting, lambda: None)
        for number in "ab":
            refused = shutter.press(feed_of, 1, WALK, stop, Press(number, now - 100))
            assert shutter.press(feed_of, 1, WALK, stop, Press(number, now - 100)) is refused
        shutter.close()
        errors = [one.error for one in shutter.pressed(WALK)]
        assert len(errors) == 2
        assert all("no picture of that moment" in one for one in errors)
    feed.close()
    assert waiting.captures() == []


def test_presses_that_an_earlier_program_kept_are_neither_taken_again_nor_refused(
    store: Store, waiting: WaitingCaptures
) -> None:
    before, replay = Shutter(store, waiting, lambda: None), Replay(example_captures())
    stop, press = Stop("1", "left", 0.0), Press("a", time.time())
    assert before.press(replay, 1, WALK, stop, press)
    before.close()
    again = Shutter(store, waiting, lambda: None)
    assert again.press(Replay(example_captures()), 1, WALK, stop, press) is None
    again.close()
    assert again.pressed(WALK) == []
    assert len(waiting.captures()) == 1


def test_what_waits_is_measured_once_though_the_program_was_killed_in_between(
    store: Store, waiting: WaitingCaptures
) -> None:
    replay = Replay(example_captures())
    shutter = Shutter(store, waiting, lambda: None)
    shutter.press(replay, 1, WALK, Stop("1", "left", 0.0), Press("a", time.time()))
    shutter.close()
    (one,) = waiting.captures()
    measurer, options = SharedMeasurer(load_registry()), MeasureOptions(instances="dataset")
    # Killed after the stop was saved and before it was let go.
    add_one(store, one.round_key, one.load(), options, key=one.key)
    settled: list[str] = []

    def settle(round_key: str) -> str:
        settled.append(round_key)
        return ""

    assert (
        measure_waiting(waiting, measurer, store, lambda: options, settle, Job(1, "measuring")) == 1
    )
    assert waiting.captures() == []
    assert settled == [DEMONSTRATION]
    assert [stop.key for stop in store.stops(DEMONSTRATION)] == [one.key]
    assert np.isclose(store.stops(DEMONSTRATION)[0].taken_s, one.pressed_s)


def test_a_damaged_capture_does_not_hold_the_others_up(
    store: Store, waiting: WaitingCaptures
) -> None:
    replay = Replay(example_captures())
    shutter = Shutter(store, waiting, lambda: None)
    for number in "ab":
        shutter.press(replay, 1, WALK, Stop("1", "left", 0.0), Press(number, time.time()))
    shutter.close()
    first, second = waiting.captures()
    (first.folder / "color_000000.png").write_bytes(b"no picture")
    measurer, options = SharedMeasurer(load_registry()), MeasureOptions(instances="dataset")
    job = Job(1, "measuring")
    measure_waiting(waiting, measurer, store, lambda: options, lambda _: "", job)
    assert [stop.key for stop in store.stops(DEMONSTRATION)] == [second.key]
    assert [one.key for one in waiting.set_aside()] == [first.key]
    assert "color_000000.png" in job.notes[0]


def test_what_waits_is_not_tried_while_nothing_can_be_measured(
    store: Store, waiting: WaitingCaptures, tmp_path: Path
) -> None:
    shutter = Shutter(store, waiting, lambda: None)
    shutter.press(Replay(example_captures()), 1, WALK, Stop("1"), Press("a", time.time()))
    shutter.close()
    lost = MeasureOptions(instances=str(tmp_path / "lost.json"))
    measurer = SharedMeasurer(load_registry())
    with pytest.raises(InstancesError):
        measure_waiting(waiting, measurer, store, lambda: lost, lambda _: "", Job(1, "measuring"))
    assert [one.tries for one in waiting.captures()] == [0]


def test_a_press_gets_the_frame_that_stays_though_nearer_ones_leave_as_it_is_kept(
    recording: Path, waiting: WaitingCaptures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CameraFeed, "_begin_watched", lambda feed: None)
    feed = CameraFeed(tmp_path / "frames", CameraConfig(playback=recording, warm_up=0, fps=15))
    capture, now = Replay(example_captures()).take(1, Stop()), time.time() - 1.0
    ring, put = FrameRing(tmp_path / "frames"), waiting.put_frames
    for after_s in (0.0, 0.01, -0.02, 0.03, 0.1, 0.3):
        ring.write(capture, now + after_s)
    burst = feed.grab(1, now)
    tries: list[Path] = []

    def thinned(frames: list[Path], *about: Any) -> Waiting:
        tries.extend(frames)
        if len(tries) < 5:  # the ring thins what is older than 3 s
            frames[0].unlink()
        return put(frames, *about)

    monkeypatch.setattr(waiting, "put_frames", thinned)
    kept = burst.keep(waiting, key_of("stop"), WALK, Stop("1"))
    assert [round((int(one.stem) / 1e6 - now), 2) for one in tries] == [0.0, 0.01, -0.02, 0.03, 0.1]
    assert len(list(kept.folder.glob("*.frame"))) == 1


def test_a_press_that_the_disk_refused_is_saved_when_it_is_sent_again(
    recording: Path, store: Store, tmp_path: Path
) -> None:
    (tmp_path / "kept").write_text("no folder")
    waiting = WaitingCaptures(tmp_path / "kept")
    config = CameraConfig(playback=recording, warm_up=0, fps=15)
    feed = CameraFeed(tmp_path / "frames", config, paced=True)
    while feed.preview().state != "playing":
        time.sleep(0.01)
    shutter, stop = Shutter(store, waiting, lambda: None), Stop("1", "left", 0.0)
    press = Press("a", time.time())
    refused = shutter.press(feed, 5, WALK, stop, press)
    assert refused is not None
    assert isinstance(refused.queued.exception(60), StoreError)
    assert not refused.is_lost
    (tmp_path / "kept").unlink()
    saved = shutter.press(feed, 5, WALK, stop, press)
    assert saved is not None
    saved.queued.result(60)
    feed.close()
    shutter.close()
    assert [one.pressed_s for one in waiting.captures()] == [press.at_s]


def test_what_waits_for_long_is_coded_and_stays_the_same(
    recording: Path, store: Store, waiting: WaitingCaptures, tmp_path: Path
) -> None:
    config = CameraConfig(playback=recording, warm_up=0, fps=15)
    feed = CameraFeed(tmp_path / "frames", config, paced=True)
    while feed.preview().state != "playing":
        time.sleep(0.01)
    shutter = Shutter(store, waiting, lambda: None)
    for number in range(6):
        pressed = shutter.press(feed, 1, WALK, Stop("1"), Press(str(number), time.time()))
        assert pressed is not None
        pressed.queued.result(60)
    feed.close()
    while not any(list(one.folder.glob("*.png")) for one in waiting.captures()):
        time.sleep(0.01)  # until the test's own limit
    shutter.close()
    coded = [bool(list(one.folder.glob("*.png"))) for one in waiting.captures()]
    assert coded[:4] == [False] * 4  # they are measured soon
    for one, is_coded in zip(waiting.captures(), coded, strict=True):
        assert bool(list(one.folder.glob("*.frame"))) is not is_coded
        assert one.load().depth_m.max() == pytest.approx(0.6, abs=1e-6)
