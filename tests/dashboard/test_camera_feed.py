from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.capture.realsense_device import CameraSettings
from cucumbervision.capture.source import example_captures
from cucumbervision.dashboard.camera_feed import CameraFeed, Preview, Replay
from cucumbervision.errors import CameraError, CaptureError


def wait_for(feed: Replay | CameraFeed, state: str, other_than: int = -1) -> Preview:
    until = time.monotonic() + 300
    while time.monotonic() < until:
        preview = feed.preview()
        if preview.state == state and preview.number != other_than:
            return preview
        time.sleep(0.02)
    raise AssertionError(f"never '{state}', but {feed.preview()}")


def test_a_replay_shows_what_it_takes_and_begins_again_at_its_end() -> None:
    replay = Replay(example_captures())
    names = []
    for _ in range(4):
        shown = wait_for(replay, "replay")
        assert shown.capture is not None
        assert shown.quality is not None
        taken = replay.take(5, Stop("7", "left", 1.5, 3))
        assert taken.name == shown.capture.name
        assert taken.stop == Stop("7", "left", 1.5, 3)
        names.append(taken.name)
    assert names == ["simulated-bench", "simulated-row-a", "simulated-row-b", "simulated-bench"]


def test_a_replay_with_nothing_readable_says_so(tmp_path: Path) -> None:
    broken = tmp_path / "one"
    broken.mkdir()
    (broken / "capture.json").write_text("{")
    replay = Replay(tmp_path)
    assert "capture.json" in wait_for(replay, "absent").message
    with pytest.raises(CaptureError, match=r"capture\.json"):
        replay.take(1, Stop())


def test_frames_of_the_camera_become_one_capture(recording: Path) -> None:
    feed = CameraFeed(CameraConfig(playback=recording, warm_up=0))
    taken = feed.take(5, Stop("2", "right", 0.8, 1))
    feed.close()
    # The block is 450 mm away and 1 mm farther each frame; the third frame is the sharpest.
    assert taken.burst_size == 5
    assert taken.burst_frame == 2
    assert taken.stop.row == "2"
    block = taken.depth_m[(taken.depth_m > 0.4) & (taken.depth_m < 0.5)]
    assert np.median(block) == pytest.approx(0.452, abs=1e-4)


@pytest.mark.parametrize(("step_px", "verdict"), [(0, "good"), (15, "moving")])
def test_a_camera_that_moves_is_told_while_it_moves(
    monkeypatch: pytest.MonkeyPatch, step_px: int, verdict: str
) -> None:
    blots = np.random.default_rng(1).integers(0, 255, (12, 16, 3), np.uint8)
    scene = blots.repeat(15, axis=0).repeat(20, axis=1)
    lens = Intrinsics(320, 180, 227.0, 227.0, 160.0, 90.0)

    class Walking:
        def __init__(self, config: CameraConfig) -> None:
            self.shown = 0

        def __enter__(self) -> Walking:
            return self

        def __exit__(self, *error: object) -> None:
            pass

        def capture_burst(self) -> Capture:
            self.shown += 1
            time.sleep(0.01)
            color = np.roll(scene, self.shown * step_px, axis=1)
            return Capture(color, np.full((180, 320), 0.5, np.float32), lens, "live")

    monkeypatch.setattr("cucumbervision.dashboard.camera_feed.RealSenseCamera", Walking)
    feed = CameraFeed(CameraConfig(warm_up=0))
    first = wait_for(feed, "live")
    later = wait_for(feed, "live", other_than=first.number)
    feed.close()
    assert later.quality is not None
    assert later.quality.verdict == verdict
    assert later.capture is not None
    assert later.capture.moved_px == 0  # a single frame is of one moment


def test_the_camera_is_released_when_nobody_looks(recording: Path) -> None:
    feed = CameraFeed(CameraConfig(playback=recording, warm_up=0), unwatched_s=0.0)
    feed.preview()
    until = time.monotonic() + 300
    while feed.open and time.monotonic() < until:
        time.sleep(0.02)
    assert not feed.open


def test_without_a_camera_the_reason_is_given_and_it_can_be_looked_for_again() -> None:
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    if len(rs.context().query_devices()):
        pytest.skip("a camera is connected")
    feed = CameraFeed(CameraConfig(warm_up=0, timeout_s=0.5))
    absent = wait_for(feed, "absent")
    assert "camera" in absent.message
    with pytest.raises(CameraError):
        feed.take(1, Stop())
    feed.close()
    assert not feed.open
    feed.retry()
    assert wait_for(feed, "absent", other_than=absent.number).number > absent.number


def test_new_settings_open_the_camera_again(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[CameraConfig] = []

    class NotedCamera(RealSenseCamera):
        def __init__(self, config: CameraConfig) -> None:
            opened.append(config)
            super().__init__(config)

    monkeypatch.setattr("cucumbervision.dashboard.camera_feed.RealSenseCamera", NotedCamera)
    feed = CameraFeed(CameraConfig(playback=recording, warm_up=0), paced=True)
    wait_for(feed, "playing")
    feed.configure(CameraSettings("high-accuracy", exposure_us=8000))
    until = time.monotonic() + 300
    while opened[-1] == opened[0] and time.monotonic() < until:
        feed.preview()
        time.sleep(0.02)
    feed.close()
    assert opened[0].settings != CameraSettings("high-accuracy", exposure_us=8000)
    assert opened[-1].settings == CameraSettings("high-accuracy", exposure_us=8000)
