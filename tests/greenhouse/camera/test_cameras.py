"""One path for a camera, a recording and a folder: what is shown, held and taken at a press."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Self

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.realsense import CameraConfig, CameraSettings
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CameraError
from cucumbervision_greenhouse.camera import cameras
from cucumbervision_greenhouse.camera.cameras import (
    HELD_S,
    Feed,
    FolderFeed,
    FrameRing,
    PictureGoneError,
    Preview,
    StreamCamera,
)

LENS = Intrinsics(320, 180, 227.0, 227.0, 160.0, 90.0)
BLOTS = np.random.default_rng(1).integers(0, 255, (12, 16, 3), np.uint8)
SCENE = BLOTS.repeat(15, axis=0).repeat(20, axis=1)


def frame(number: int, step_px: int = 0, timestamp_s: float | None = None) -> Capture:
    """A wall that is 1 mm farther in each frame."""
    color = np.roll(SCENE, number * step_px, axis=1)
    depth = np.full((180, 320), 0.5 + 0.001 * number, np.float32)
    return Capture(color, depth, LENS, f"c{number}", frame=number, timestamp_s=timestamp_s)


class Walking(StreamCamera):
    """A camera that sends the frames that a test lets go, each at its time."""

    def __init__(self, step_px: int = 0) -> None:
        super().__init__(CameraConfig())
        self.step_px, self.count, self.opened = step_px, 0, list[CameraSettings]()
        self.due, self.released = threading.Semaphore(0), threading.Event()

    def __enter__(self) -> Self:
        self.opened.append(self.settings)
        return self

    def __exit__(self, *error: object) -> None:
        self.released.set()

    def read(self) -> Capture:
        if not self.due.acquire(timeout=60):
            raise CameraError("nothing", remedy="test")
        self.count += 1
        return frame(self.count, self.step_px, time.time())

    def send(self, feed: Feed, number: int = 1) -> Preview:
        """Let frames go, and return what is shown once the last is in the ring."""
        feed.preview()
        until = self.count + number
        for _ in range(number):
            self.due.release()
        with feed._changed:
            frames = feed._ring.frames
            assert feed._changed.wait_for(
                lambda: bool(feed._ring.frames) and feed._ring.frames[-1].capture.frame == until, 60
            ), frames
        return feed.preview()


def shown(feed: Feed, state: str, after: int = -1) -> Preview:
    """Wait until a feed is in a state."""
    with feed._changed:
        feed._watch()
        assert feed._changed.wait_for(lambda: feed._state == state and feed._count > after, 300)
        return feed.preview()


@pytest.mark.parametrize(("step_px", "verdict"), [(0, "good"), (15, "moving")])
def test_a_camera_that_moves_is_told_while_it_moves(
    tmp_path: Path, step_px: int, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cameras, "REACH_S", 60.0)
    camera = Walking(step_px)
    feed = Feed(camera, tmp_path)
    later = camera.send(feed, 2)
    camera.due.release()
    feed.close()
    assert later.quality is not None
    assert later.quality.verdict == verdict
    assert later.capture is not None
    assert later.capture.moved_px == 0  # a single frame is of one moment


def test_a_recording_is_played_as_a_camera_and_begins_again(
    recording: Path, tmp_path: Path
) -> None:
    feed = Feed(StreamCamera(CameraConfig(playback=recording, warm_up=0, fps=15)), tmp_path)
    first = shown(feed, "playing")
    assert first.capture is not None
    taken = feed.grab(5, time.time())
    feed.close()
    assert feed._thread is None
    assert 1 <= taken.burst_size <= 5
    # The block is 450 mm away and 1 mm farther in each frame.
    block = taken.depth_m[(taken.depth_m > 0.4) & (taken.depth_m < 0.5)]
    assert 0.449 < np.median(block) < 0.5


def test_the_camera_is_released_when_nobody_looks(tmp_path: Path) -> None:
    camera = Walking()
    feed = Feed(camera, tmp_path, unwatched_s=0.2)
    feed.preview()
    assert not camera.released.wait(0.25)  # it waits for a frame
    camera.due.release()
    assert camera.released.wait(60)


def test_without_a_camera_the_reason_is_given_and_it_can_be_looked_for_again(
    tmp_path: Path,
) -> None:
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    if len(rs.context().query_devices()):
        pytest.skip("a camera is connected")
    feed = Feed(StreamCamera(CameraConfig(warm_up=0, timeout_s=0.5)), tmp_path)
    absent = shown(feed, "absent")
    assert "camera" in absent.message
    with pytest.raises(CameraError):
        feed.grab(1, time.time())
    assert feed._thread is None
    feed.retry()
    assert shown(feed, "absent", absent.number).number > absent.number


def test_new_settings_open_the_camera_again(tmp_path: Path) -> None:
    camera, chosen = Walking(), CameraSettings("high-accuracy", exposure_us=8000)
    feed = Feed(camera, tmp_path)
    camera.send(feed)
    feed.configure(chosen)
    camera.send(feed, 2)
    camera.due.release()
    feed.close()
    assert camera.opened == [CameraSettings(), chosen]


def test_the_ring_holds_all_new_frames_and_some_of_the_older(tmp_path: Path) -> None:
    ring = FrameRing(tmp_path)
    for number in range(100):
        ring.put(frame(number), 1000.0 + 0.1 * number)
    times = [held.at_s for held in ring.frames]
    assert times == sorted(times)
    assert [held.capture.depth_m[0, 0] for held in ring.frames] == pytest.approx(
        [0.5 + 0.01 * (at_s - 1000.0) for at_s in times]
    )
    new = [at_s for at_s in times if at_s > 1009.9 - 3.0]
    assert len(new) == 30
    gaps = np.diff([at_s for at_s in times if at_s <= 1009.9 - 3.0])
    assert gaps == pytest.approx(np.full(len(gaps), 0.3))
    ring.put(frame(0), 1009.9 + HELD_S + 1)
    assert len(ring.frames) == 1
    assert list(tmp_path.iterdir()) == []  # the file goes with the program


def test_a_small_ring_drops_the_oldest_and_a_full_disk_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ring = FrameRing(tmp_path, most=3)
    for number in range(5):
        ring.put(frame(number), 1000.0 + number)
    assert [held.capture.frame for held in ring.frames] == [2, 3, 4]
    monkeypatch.setattr(cameras, "_RESERVE_BYTES", 10**18)
    with pytest.raises(CameraError, match="no space left"):
        FrameRing(tmp_path).put(frame(0), 1000.0)


def held(tmp_path: Path, *after_s: float, now_s: float) -> Feed:
    """A feed whose ring holds frames of some times, and gets no more."""
    camera = Walking()
    feed = Feed(camera, tmp_path)
    with feed._changed:
        for number, at_s in enumerate(after_s):
            feed._ring.put(frame(number), now_s + at_s)
        feed._thread, feed._state = threading.current_thread(), "live"
    return feed


def test_a_late_press_gets_the_picture_of_its_moment(tmp_path: Path) -> None:
    now_s = time.time() - 10
    feed = held(tmp_path, 0.0, 0.5, 1.0, 1.5, 2.0, 4.0, now_s=now_s)
    for pressed_s, number in ((0.1, 0), (0.3, 1), (1.6, 3), (2.9, 4)):
        assert feed.grab(1, now_s + pressed_s).frame == number
    # Frames within 0.15 s are fused, of which there is none but the nearest.
    assert feed.grab(5, now_s + 1.0).burst_size == 1
    with pytest.raises(PictureGoneError):
        feed.grab(1, now_s - 2.0)


def test_a_burst_is_the_nearest_frames_however_they_lie_about_the_press(tmp_path: Path) -> None:
    now_s = time.time()
    times = (-0.14, -0.08, -0.03, -0.01, 0.05, 0.12, 0.3)
    fused = held(tmp_path, *times, now_s=now_s).grab(5, now_s)
    assert (fused.burst_size, fused.name) == (5, "c1")
    # The median of 0.501 to 0.505 m.
    assert fused.depth_m == pytest.approx(np.full((180, 320), 0.503), abs=1e-6)


def test_a_press_between_frames_waits_for_the_next_and_takes_the_nearer(tmp_path: Path) -> None:
    camera = Walking()
    feed = Feed(camera, tmp_path)
    camera.send(feed)
    pressed_s = time.time() + 0.3
    with ThreadPoolExecutor(1) as pool:
        taken = pool.submit(feed.grab, 1, pressed_s)
        assert not taken.done()
        while not taken.done():  # frames until one lies behind the press
            camera.send(feed)
        assert abs((taken.result(60).timestamp_s or 0.0) - pressed_s) < 0.3
    camera.due.release()
    feed.close()


def test_a_folder_shows_what_the_next_press_takes_and_begins_again_at_its_end() -> None:
    feed, names = FolderFeed(example_captures()), []
    for _ in range(4):
        preview = feed.preview()
        assert preview is feed.preview()
        assert preview.capture is not None
        assert preview.quality is not None
        # A folder has no moments: presses of a gap or a kill are served as well.
        names.append(feed.grab(5, time.time() - 500).name)
        assert names[-1] == preview.capture.name
    assert names == ["simulated-bench", "simulated-row-a", "simulated-row-b", "simulated-bench"]


def test_a_folder_with_nothing_readable_says_so(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "capture.json").write_text("{")
    feed = FolderFeed(tmp_path)
    assert feed.preview().state == "absent"
    assert "capture.json" in feed.preview().message
    with pytest.raises(CameraError, match=r"capture\.json"):
        feed.grab(1, time.time())


def test_many_who_press_at_once_each_get_the_next_capture() -> None:
    feed = FolderFeed(example_captures())
    with ThreadPoolExecutor(8) as hands:
        names = list(hands.map(lambda _: feed.grab(1, time.time()).name, range(24)))
    assert {name: names.count(name) for name in names} == {
        "simulated-bench": 8,
        "simulated-row-a": 8,
        "simulated-row-b": 8,
    }
