from __future__ import annotations

import threading
import time
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest
from tests.greenhouse.camera.test_cameras import Walking, frame
from tests.greenhouse.conftest import add_one, measure_waiting

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.realsense import CameraConfig
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import StoreError
from cucumbervision.networks.registry import load_registry
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.camera.cameras import Feed, FolderFeed, StreamCamera
from cucumbervision_greenhouse.camera.shutter import Shutter, is_lost
from cucumbervision_greenhouse.measuring import SharedMeasurer
from cucumbervision_greenhouse.resources import fault_of
from cucumbervision_greenhouse.rounds.walking import DEMONSTRATION
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import Waiting, WaitingCaptures

WALK = key_of("walk")


@pytest.fixture
def waiting(tmp_path: Path) -> WaitingCaptures:
    return WaitingCaptures(tmp_path / "kept")


def folder() -> FolderFeed:
    return FolderFeed(example_captures())


def played(recording: Path, path: Path) -> Feed:
    """A recording in the camera's place, of which the first frame is there."""
    feed = Feed(StreamCamera(CameraConfig(playback=recording, warm_up=0, fps=15)), path / "frames")
    feed.grab(1, time.time())
    return feed


def held(path: Path, seconds: float, now_s: float) -> Feed:
    """A camera that has been open for some time, and sends no more."""
    feed = Feed(Walking(), path / "frames")
    with feed._changed:
        for number in range(int(4 * seconds) + 1):
            feed._ring.put(frame(number), now_s - seconds + 0.25 * number)
        feed._thread, feed._state = threading.current_thread(), "live"
    return feed


def test_quick_presses_are_each_a_stop_and_none_counts_twice(
    store: Store, waiting: WaitingCaptures
) -> None:
    replay, told = folder(), list[int]()
    shutter = Shutter(store, waiting, lambda: told.append(1))
    for number in "aabbc":
        shutter.press(replay, 1, WALK, Stop("1", "left", 0.0), number, time.time())
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
    replay, shutter = folder(), Shutter(store, waiting, lambda: None)
    places = [("a", 0.0), ("b", 0.5), ("c", 0.5), ("d", 0.0), ("e", 0.75)]
    for number, at_m in places:
        shutter.press(replay, 1, WALK, Stop("1", "left", at_m), number, time.time())
    shutter.press(replay, 1, WALK, Stop("1", "right", 0.5), "other side", time.time())
    shutter.close()
    kept = [one.stop.position_m for one in waiting.captures()]
    # The third and fourth go on from the last, as far as the last two lie apart.
    assert kept == [0.0, 0.5, 1.0, 1.5, 0.75, 0.5]


def test_a_press_whose_picture_is_gone_is_refused_and_told(
    recording: Path, store: Store, waiting: WaitingCaptures, tmp_path: Path
) -> None:
    stop, now = Stop("1", "left", 0.0), time.time()
    feed, shutter = played(recording, tmp_path), Shutter(store, waiting, lambda: None)
    refused = shutter.press(feed, 1, WALK, stop, "a", now - 100)
    assert shutter.press(feed, 1, WALK, stop, "a", now - 100) is refused
    shutter.close()
    feed.close()
    assert refused is not None
    assert "no picture of that moment" in fault_of(refused)
    assert waiting.captures() == []


def test_every_press_of_a_walk_with_gaps_has_its_picture(
    store: Store, waiting: WaitingCaptures, tmp_path: Path
) -> None:
    """A walk of 60 presses, of which a third come late and together."""
    until_s = time.time()
    feeds: tuple[Feed | FolderFeed, ...] = held(tmp_path, 30.0, until_s), folder()
    for feed in feeds:
        shutter, told = Shutter(store, waiting, lambda: None), list[Future[Waiting] | None]()
        moments = [until_s - 30.0 + 0.5 * k for k in range(60)]
        for number in sorted(range(60), key=lambda k: (k // 20 == 1, k)):
            place = Stop("1", "left", 0.4 * number)
            told.append(shutter.press(feed, 1, WALK, place, f"{number}", moments[number]))
        shutter.close()
        assert [one and fault_of(one) for one in told] == [""] * 60
        assert len(waiting.captures()) == 60
        for one in waiting.captures():
            waiting.done(one)


def test_presses_that_an_earlier_program_kept_are_neither_taken_again_nor_refused(
    store: Store, waiting: WaitingCaptures
) -> None:
    before, replay = Shutter(store, waiting, lambda: None), folder()
    stop, now = Stop("1", "left", 0.0), time.time()
    assert before.press(replay, 1, WALK, stop, "a", now)
    before.close()
    again = Shutter(store, waiting, lambda: None)
    assert again.press(folder(), 1, WALK, stop, "a", now) is None
    again.close()
    assert len(waiting.captures()) == 1


def test_what_waits_is_measured_once_though_the_program_was_killed_in_between(
    store: Store, waiting: WaitingCaptures
) -> None:
    replay = folder()
    shutter = Shutter(store, waiting, lambda: None)
    shutter.press(replay, 1, WALK, Stop("1", "left", 0.0), "a", time.time())
    shutter.close()
    (one,) = waiting.captures()
    measurer, options = SharedMeasurer(load_registry()), MeasureOptions(instances="dataset")
    # Killed after the stop was saved and before it was let go.
    add_one(store, one.round_key, one.load(), options, key=one.key)
    settled: list[str] = []

    assert measure_waiting(waiting, measurer, store, lambda: options, settled.append) == 1
    assert waiting.captures() == []
    assert settled == [DEMONSTRATION]
    assert [stop.key for stop in store.stops(DEMONSTRATION)] == [one.key]
    assert np.isclose(store.stops(DEMONSTRATION)[0].taken_s, one.pressed_s)


def test_a_damaged_capture_does_not_hold_the_others_up(
    store: Store, waiting: WaitingCaptures, caplog: pytest.LogCaptureFixture
) -> None:
    replay = folder()
    shutter = Shutter(store, waiting, lambda: None)
    for number in "ab":
        shutter.press(replay, 1, WALK, Stop("1", "left", 0.0), number, time.time())
    shutter.close()
    first, second = waiting.captures()
    (first.folder / "color_000000.png").write_bytes(b"no picture")
    measurer, options = SharedMeasurer(load_registry()), MeasureOptions(instances="dataset")
    measure_waiting(waiting, measurer, store, lambda: options)
    assert [stop.key for stop in store.stops(DEMONSTRATION)] == [second.key]
    assert [one.key for one in waiting.set_aside()] == [first.key]
    assert "color_000000.png" in caplog.text


def test_a_press_that_the_disk_refused_is_saved_when_it_is_sent_again(
    recording: Path, store: Store, tmp_path: Path
) -> None:
    (tmp_path / "kept").write_text("no folder")
    waiting = WaitingCaptures(tmp_path / "kept")
    feed = played(recording, tmp_path)
    shutter, stop = Shutter(store, waiting, lambda: None), Stop("1", "left", 0.0)
    now = time.time()
    refused = shutter.press(feed, 5, WALK, stop, "a", now)
    assert refused is not None
    assert isinstance(refused.exception(60), StoreError)
    assert not is_lost(refused)
    (tmp_path / "kept").unlink()
    saved = shutter.press(feed, 5, WALK, stop, "a", now)
    assert saved is not None
    saved.result(60)
    feed.close()
    shutter.close()
    assert [one.pressed_s for one in waiting.captures()] == [now]
