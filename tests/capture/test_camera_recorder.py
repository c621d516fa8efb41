"""Recording from cameras that the SDK plays, from a folder, and onto disks that refuse."""

from __future__ import annotations

import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.camera import FolderCamera, Recorded, Walk, record_captures
from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.errors import CameraError, CucumberVisionError


def test_a_walk_is_written_as_it_was_taken(recording: Path, tmp_path: Path) -> None:
    config = CameraConfig(playback=recording, burst=5, warm_up=0)
    written = [
        one
        for one in record_captures(
            lambda: RealSenseCamera(config), tmp_path, range(4), Walk("3", "left", 1.0, 0.4)
        )
        if isinstance(one, Recorded)
    ]
    assert [one.path.parent.name for one in written] == [f"capture_000{k}" for k in (1, 2, 3, 4)]
    read = [ref.load() for ref in open_source(tmp_path)]
    # The SDK's frames 1 to 20 make bursts of five; those of the reader of recordings are the same.
    assert [one.frame for one in read] == [1, 6, 11, 16]
    straight = [ref.load() for ref in open_source(recording)]
    for one, other in zip(read, straight, strict=False):
        np.testing.assert_array_equal(one.depth_m, other.depth_m)
        np.testing.assert_array_equal(one.color, other.color)
    assert [one.stop for one in read] == [
        Stop("3", "left", at, k) for k, at in enumerate((1.0, 1.4, 1.8, 2.2), start=1)
    ]
    assert read[0].provenance["serial"] == "0042"
    assert written[0].quality.verdict == "good"


def test_numbers_go_on_after_the_last_that_is_there(capture: Capture, tmp_path: Path) -> None:
    inbox, out = tmp_path / "inbox", tmp_path / "out"
    (out / "row_0007").mkdir(parents=True)  # broke off before its capture.json was written
    for name in ("a", "b"):
        write_native(replace(capture, name=name), inbox / name)
    done = record_captures(lambda: FolderCamera(inbox, old=True), out, "xx", name="row")
    names = [one.path.parent.name for one in done if isinstance(one, Recorded)]
    assert names == ["row_0008", "row_0009"]


def test_what_cannot_be_written_costs_the_next_nothing(capture: Capture, tmp_path: Path) -> None:
    inbox, out = tmp_path / "inbox", tmp_path / "out"
    for name in ("a", "b"):
        write_native(replace(capture, name=name), inbox / name)
    out.mkdir()
    (out / "capture_0001").write_text("a file is in the way")
    signals = iter("xx")
    done = list(record_captures(lambda: FolderCamera(inbox, old=True), out, signals, name="other"))
    assert all(isinstance(one, Recorded) for one in done)
    blocked = out / "blocked"
    blocked.write_text("no folder")
    done = list(record_captures(lambda: FolderCamera(inbox, old=True), blocked, "xx"))
    assert [isinstance(one, CucumberVisionError) for one in done] == [True, True]


def test_a_recording_that_ends_is_a_camera_that_is_gone(recording: Path, tmp_path: Path) -> None:
    config = CameraConfig(playback=recording, burst=20, warm_up=0)
    taken: list[object] = []
    with pytest.raises(CameraError, match="the recording is over"):
        taken.extend(record_captures(lambda: RealSenseCamera(config), tmp_path, "xxx"))
    assert len(taken) == 1


def test_the_command_takes_one_at_each_line(capture: Capture, tmp_path: Path) -> None:
    inbox, out = tmp_path / "inbox", tmp_path / "out"
    inbox.mkdir()
    code = "from cucumbervision.cli.app import main; main()"
    command = [sys.executable, "-c", code, "record", str(out), "--from", str(inbox), "--row", "3"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write("\n")
        process.stdin.flush()
        # The camera opens at the first signal and passes over what is there: keep them coming.
        k = 0
        seen = threading.Event()

        def fill() -> None:
            nonlocal k
            while not seen.wait(0.3):
                k += 1
                write_native(replace(capture, name=f"c{k}"), inbox / f"c{k}")

        filler = threading.Thread(target=fill)
        filler.start()
        line = process.stdout.readline()
        seen.set()
        filler.join()
        _, told = process.communicate(timeout=120)
    assert "capture_0001" in line
    assert "1 captures written, 0 failed" in told
    assert process.returncode == 0
    (ref,) = open_source(out)
    assert ref.load().stop == Stop("3", None, None, 1)
