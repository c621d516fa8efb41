from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tests.greenhouse.conftest import ThreadRecorder

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.raw_frames import FrameRing
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.capture.realsense_device import CameraSettings
from cucumbervision.errors import CameraError
from cucumbervision_greenhouse.backend.camera_feed import FAR_S, CameraFeed, Preview
from cucumbervision_greenhouse.backend.replay_feed import Feed


def wait_for(feed: Feed, state: str, other_than: int = -1) -> Preview:
    until = time.monotonic() + 300
    while time.monotonic() < until:
        preview = feed.preview()
        if preview.state == state and preview.number != other_than:
            return preview
        time.sleep(0.02)
    raise AssertionError(f"never '{state}', but {feed.preview()}")


def test_frames_of_the_camera_become_one_capture(recording: Path, tmp_path: Path) -> None:
    feed = CameraFeed(tmp_path, CameraConfig(playback=recording, warm_up=0))
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
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, step_px: int, verdict: str
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

    monkeypatch.setattr("cucumbervision_greenhouse.backend.camera_process.RealSenseCamera", Walking)
    feed = CameraFeed(tmp_path, CameraConfig(warm_up=0), start=ThreadRecorder)
    first = wait_for(feed, "live")
    later = wait_for(feed, "live", other_than=first.number)
    feed.close()
    assert later.quality is not None
    assert later.quality.verdict == verdict
    assert later.capture is not None
    assert later.capture.moved_px == 0  # a single frame is of one moment


def test_the_camera_is_released_when_nobody_looks(recording: Path, tmp_path: Path) -> None:
    feed = CameraFeed(tmp_path, CameraConfig(playback=recording, warm_up=0), unwatched_s=0.5)
    wait_for(feed, "playing")
    until = time.monotonic() + 300
    while feed.open and time.monotonic() < until:
        time.sleep(0.02)
    assert not feed.open


def test_without_a_camera_the_reason_is_given_and_it_can_be_looked_for_again(
    tmp_path: Path,
) -> None:
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    if len(rs.context().query_devices()):
        pytest.skip("a camera is connected")
    feed = CameraFeed(tmp_path, CameraConfig(warm_up=0, timeout_s=0.5))
    absent = wait_for(feed, "absent")
    assert "camera" in absent.message
    with pytest.raises(CameraError):
        feed.take(1, Stop())
    feed.close()
    assert not feed.open
    feed.retry()
    assert wait_for(feed, "absent", other_than=absent.number).number > absent.number


def test_new_settings_open_the_camera_again(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[CameraConfig] = []

    class NotedCamera(RealSenseCamera):
        def __init__(self, config: CameraConfig) -> None:
            opened.append(config)
            super().__init__(config)

    monkeypatch.setattr(
        "cucumbervision_greenhouse.backend.camera_process.RealSenseCamera", NotedCamera
    )
    config = CameraConfig(playback=recording, warm_up=0)
    feed = CameraFeed(tmp_path, config, paced=True, start=ThreadRecorder)
    wait_for(feed, "playing")
    feed.configure(CameraSettings("high-accuracy", exposure_us=8000))
    until = time.monotonic() + 300
    while opened[-1] == opened[0] and time.monotonic() < until:
        feed.preview()
        time.sleep(0.02)
    feed.close()
    assert opened[0].settings != CameraSettings("high-accuracy", exposure_us=8000)
    assert opened[-1].settings == CameraSettings("high-accuracy", exposure_us=8000)


def refuse_start(folder: Path) -> ThreadRecorder:
    raise AssertionError(f"another process was started in {folder}")


def test_the_camera_goes_on_while_its_server_is_killed_and_started_again(
    recording: Path, tmp_path: Path
) -> None:
    script = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from cucumbervision.capture.realsense import CameraConfig\n"
        "from cucumbervision_greenhouse.backend.camera_feed import CameraFeed\n"
        "config = CameraConfig(playback=Path(sys.argv[2]), warm_up=0, fps=15)\n"
        "feed = CameraFeed(Path(sys.argv[1]), config, paced=True)\n"
        "while feed.preview().state != 'playing':\n"
        "    time.sleep(0.02)\n"
        "print('playing', flush=True)\n"
        "time.sleep(600)\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path), str(recording)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        assert server.stdout.readline() == "playing\n"
        os.kill(server.pid, signal.SIGKILL)
    killed_s = time.time()
    while not any(frame.at_s > killed_s + 0.5 for frame in FrameRing(tmp_path).frames()):
        time.sleep(0.05)  # until the test's own limit
    config = CameraConfig(playback=recording, warm_up=0, fps=15)
    feed = CameraFeed(tmp_path, config, paced=True, start=refuse_start)
    # Pressed while there was no server at all.
    burst = feed.grab(5, killed_s + 0.2)
    assert burst.capture().burst_size >= 1
    assert burst.nearest_s < FAR_S
    assert feed.preview().state == "playing"
    feed.close()
    assert not feed.open


def test_a_camera_program_that_crashes_each_time_is_not_started_for_ever(tmp_path: Path) -> None:
    started: list[Path] = []

    class Crashed:
        def __init__(self, folder: Path) -> None:
            started.append(folder)

        def poll(self) -> int:
            return -11

    feed = CameraFeed(tmp_path, CameraConfig(warm_up=0), start=Crashed)
    assert "ended 3 times (-11)" in wait_for(feed, "absent").message
    assert len(started) == 3
