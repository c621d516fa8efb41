"""Cameras of any make: a folder that fills, cameras that go and come back."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Self

import pytest

from cucumbervision.capture.camera import FolderCamera, captures_of
from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.readers.native import write_native
from cucumbervision.errors import CameraError, CaptureError, DepthError


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
