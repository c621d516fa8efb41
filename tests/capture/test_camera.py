"""Cameras of any make: a folder that fills, cameras that go and come back."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np
import pytest

from cucumbervision.capture.camera import FolderCamera, Recorded, Walk, captures_of, record_captures
from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.errors import CameraError, CaptureError, CucumberVisionError, DepthError


class Scripted:
    """A camera that gives what it is told: captures, and errors."""

    def __init__(self, script: list[Capture | Exception]) -> None:
        self.device: dict[str, str] = {"camera": "scripted"}
        self._script = script
        self.opened = self.closed = 0

    def __enter__(self) -> Self:
        self.opened += 1
        return self

    def __exit__(self, *error: object) -> None:
        self.closed += 1

    def capture_burst(self, name: str | None = None, *, stop: Stop | None = None) -> Capture:
        one = self._script.pop(0) if self._script else CameraError("unplugged")
        if isinstance(one, Exception):
            raise one
        return one


def test_a_camera_that_is_gone_is_opened_again(capture: Capture) -> None:
    gone = CameraError("unplugged")
    camera = Scripted([capture, gone, gone, capture, DepthError("dark"), capture, gone, gone, gone])
    naps: list[float] = []
    given: list[object] = []
    with pytest.raises(CameraError, match="unplugged"):
        given.extend(captures_of(lambda: camera, 2, pause_s=0.5, sleep=naps.append))
    assert [type(one) for one in given] == [Capture, Capture, DepthError, Capture]
    # Twice before the second capture, twice more at the end.
    assert (naps, camera.opened, camera.closed) == ([0.5] * 4, 5, 5)


def test_a_camera_is_let_go_when_nobody_wants_more(capture: Capture) -> None:
    camera = Scripted([capture, capture])
    captures = captures_of(lambda: camera)
    assert next(captures) is capture
    captures.close()
    assert (camera.opened, camera.closed) == (1, 1)


def test_a_folder_gives_what_is_new_once_each(capture: Capture, tmp_path: Path) -> None:
    write_native(replace(capture, name="old"), tmp_path / "old")
    with FolderCamera(tmp_path) as camera:
        for name in ("b", "a"):
            write_native(replace(capture, name=name), tmp_path / name)
        assert camera.capture_burst().name == "a"
        stop = Stop("7", "left", 2.5, 3)
        second = camera.capture_burst("mine", stop=stop)
        assert (second.name, second.stop) == ("mine", stop)
        assert second.simulated is capture.simulated
        assert (second.depth_m == capture.depth_m).all()


def test_a_capture_that_stays_broken_is_reported_once(capture: Capture, tmp_path: Path) -> None:
    ticks = itertools.count(0.0, 1.0)
    camera = FolderCamera(
        tmp_path, timeout_s=20, settle_s=3, clock=lambda: next(ticks), sleep=lambda _: None
    )
    with camera:
        write_native(capture, tmp_path / "broken")
        (tmp_path / "broken" / "depth_000000.png").write_bytes(b"half")
        with pytest.raises(CaptureError, match="broken"):
            camera.capture_burst()
        with pytest.raises(CameraError, match="no capture has appeared for 20 s"):
            camera.capture_burst()


def test_a_copy_that_pauses_too_long_is_read_when_it_goes_on(
    capture: Capture, tmp_path: Path
) -> None:
    ticks = itertools.count(0.0, 1.0)
    camera = FolderCamera(
        tmp_path, timeout_s=20, settle_s=3, clock=lambda: next(ticks), sleep=lambda _: None
    )
    with camera:
        write_native(capture, tmp_path / "slow")
        depth = tmp_path / "slow" / "depth_000000.png"
        data = depth.read_bytes()
        depth.write_bytes(data[:-9])
        with pytest.raises(CaptureError, match="slow"):
            camera.capture_burst()
        depth.write_bytes(data)
        assert (camera.capture_burst().depth_m == capture.depth_m).all()


def test_a_folder_is_remembered_no_longer_than_its_captures(
    capture: Capture, tmp_path: Path
) -> None:
    with FolderCamera(tmp_path) as camera:
        write_native(replace(capture, name="kept"), tmp_path / "kept")
        camera.capture_burst()
        for number in range(12):
            for name in (f"c{number}", "again"):
                write_native(replace(capture, name=name, frame=number), tmp_path / name)
                taken = camera.capture_burst()
                assert (taken.name, taken.frame) == (name, number)
            shutil.rmtree(tmp_path / f"c{number}")
            shutil.rmtree(tmp_path / "again")
        (tmp_path / "half").mkdir()
        (tmp_path / "half" / "capture.json").write_text("{")
        with pytest.raises(CameraError):
            impatient(camera)
        shutil.rmtree(tmp_path / "half")
        write_native(capture, tmp_path / "last")
        camera.capture_burst()
        remembered = [len(part) for part in vars(camera).values() if isinstance(part, set | dict)]
    assert max(remembered) == 2


def impatient(camera: FolderCamera) -> None:
    camera._timeout_s = 0.0
    camera.capture_burst()


def test_a_folder_that_is_not_there_is_no_camera(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="no such folder"), FolderCamera(tmp_path / "none"):
        pass


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
