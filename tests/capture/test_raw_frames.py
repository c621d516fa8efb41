from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, Doubt, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.raw_frames import FrameRing, read_frame, write_frame
from cucumbervision.errors import CaptureError

CAMERA = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)


def capture(depth_m: float = 0.5) -> Capture:
    color = np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8)
    return Capture(
        color,
        np.full((48, 64), depth_m, np.float32),
        CAMERA,
        "c",
        frame=7,
        burst_frame=1,
        burst_size=2,
        moved_px=0.5,
        stop=Stop("3", "left", 0.4, 2),
        timestamp_s=1_700_000_000.25,
        source="camera 42",
        provenance={"reader": "camera", "serial": "42"},
        gravity=(0.0, 1.0, 0.0),
        doubts=(Doubt.DEPTH_RESAMPLED,),
    )


# Whole millimetres, a half, one that 16 bits do not reach, and none: each exactly.
@pytest.mark.parametrize(("depth_m", "bytes_px"), [(0.454, 5), (0.4545, 7), (70.0, 7), (0.0, 5)])
def test_a_frame_is_read_as_it_was_written(tmp_path: Path, depth_m: float, bytes_px: int) -> None:
    frame, path = capture(depth_m), tmp_path / "a.frame"
    write_frame(frame, path)
    assert bytes_px == path.stat().st_size // (48 * 64)
    back = read_frame(path)
    assert back.depth_m.dtype == np.float32
    for field in fields(Capture):
        was, read = getattr(frame, field.name), getattr(back, field.name)
        assert np.array_equal(was, read) if field.name in ("color", "depth_m") else was == read


@pytest.mark.parametrize("cut", [0, 1, 30, 400, 1000, -1])
def test_a_frame_that_is_cut_off_is_refused_by_name(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "a.frame"
    write_frame(capture(), path)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(CaptureError, match=r"a\.frame: is no whole frame"):
        read_frame(path)
    path.unlink()
    with pytest.raises(CaptureError, match="cannot be read"):
        read_frame(path)


def test_a_ring_keeps_all_new_frames_some_of_the_older_and_none_that_are_too_old(
    tmp_path: Path,
) -> None:
    ring = FrameRing(tmp_path, kept_s=10.0, dense_s=1.0, sparse_s=0.5)
    for step in range(200):
        ring.write(capture(), 100 + 0.1 * step, now_s=100 + 0.1 * step)
    ages_s = [round(119.9 - frame.at_s, 1) for frame in ring.frames()]
    assert ages_s[-11:] == [1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.0]
    assert 9.5 <= ages_s[0] <= 10.1
    assert np.diff(ages_s[:-12]) == pytest.approx(-0.5)


def test_a_ring_stays_within_its_room_and_drops_what_is_of_the_future(tmp_path: Path) -> None:
    size = 48 * 64 * 5 + 1000
    ring = FrameRing(tmp_path, most_bytes=4 * size)
    for step in range(8):
        ring.write(capture(), 100.0 + step, now_s=100.0 + step)
    assert [frame.at_s for frame in ring.frames()] == [103.0, 104.0, 105.0, 106.0, 107.0]
    # The clock is set back by an hour.
    ring.write(capture(), 50.0, now_s=50.0 - 3600)
    ring.write(capture(), 51.0, now_s=51.0)
    assert [frame.at_s for frame in ring.frames()] == [50.0, 51.0]


def test_a_writer_that_is_killed_leaves_whole_frames_and_the_next_goes_on(tmp_path: Path) -> None:
    script = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "import numpy as np\n"
        "from cucumbervision.capture.frames import Capture\n"
        "from cucumbervision.capture.intrinsics import Intrinsics\n"
        "from cucumbervision.capture.raw_frames import FrameRing\n"
        "lens = Intrinsics(640, 480, 600, 600, 320, 240)\n"
        "depth, color = np.full((480, 640), 0.5, np.float32), np.zeros((480, 640, 3), np.uint8)\n"
        "frame, ring = Capture(color, depth, lens, 'a'), FrameRing(Path(sys.argv[1]))\n"
        "while True:\n"
        "    ring.write(frame, time.time())\n"
        "    print('.', flush=True)\n"
    )
    for _ in range(3):
        command = [sys.executable, "-c", script, str(tmp_path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None
            for _ in range(5):
                writer.stdout.readline()
            os.kill(writer.pid, signal.SIGKILL)
        frames = FrameRing(tmp_path).frames()
        assert len(frames) >= 5
        assert all(frame.load().fill == 1.0 for frame in frames)
