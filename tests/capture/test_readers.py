from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.errors import CaptureError


def test_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"none: does not exist; check the path"):
        open_source(tmp_path / "none")


def test_what_holds_no_captures(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(CaptureError, match=r"holds no captures .* but 1 \.txt; give a"):
        open_source(tmp_path)
    with pytest.raises(CaptureError, match=r"notes\.txt: '\.txt' files are not captures"):
        open_source(str(tmp_path / "notes.txt"))


def test_a_folder_of_several_kinds_gives_all_of_them(tmp_path: Path, capture: Capture) -> None:
    write_native(capture, tmp_path / "a")
    write_png(tmp_path / "color_1.png", capture.color)
    np.save(tmp_path / "depth_1.npy", capture.depth_m)
    camera = CameraModel.of(capture.intrinsics).model_dump_json()
    (tmp_path / "intrinsics.json").write_text(camera)
    source = open_source(tmp_path)
    assert (source.kind, source.total) == ("native+pair", 2)
    for ref in source:
        np.testing.assert_array_equal(ref.load().depth_m, capture.depth_m)


def test_a_folder_is_looked_at_once_however_it_is_linked(tmp_path: Path, capture: Capture) -> None:
    write_native(capture, tmp_path / "walk" / "a")
    (tmp_path / "walk" / "b").symlink_to(tmp_path / "walk", target_is_directory=True)
    (tmp_path / "walk" / "c").symlink_to(tmp_path / "walk" / "a", target_is_directory=True)
    (tmp_path / "walk" / "d").symlink_to("/", target_is_directory=True)
    assert open_source(tmp_path).total == 1


@pytest.mark.parametrize("name", ["rgb_1.png", "depth_1.png", "intrinsics.json"])
def test_pipes_and_devices_are_refused(name: str, tmp_path: Path, capture: Capture) -> None:
    write_png(tmp_path / "rgb_1.png", capture.color)
    write_png(tmp_path / "depth_1.png", (1000 * capture.depth_m).astype(np.uint16))
    camera = CameraModel.of(capture.intrinsics).model_dump_json()
    (tmp_path / "intrinsics.json").write_text(camera)
    (tmp_path / name).unlink()
    if name == "depth_1.png":
        os.mkfifo(tmp_path / name)
    else:
        (tmp_path / name).symlink_to("/dev/zero")
    with pytest.raises(CaptureError, match=f"{name}: is a pipe or a device, not a file"):
        next(iter(open_source(tmp_path))).load()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(CaptureError, match="pipe: is neither a file nor a folder"):
        open_source(tmp_path / "pipe")


def test_a_closed_folder_fails_by_its_name_and_the_others_load(
    tmp_path: Path, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        write_native(capture, tmp_path / name)
    walk = os.walk

    def refused(path: Path, onerror: Any = None, **how: Any) -> Iterator[Any]:
        for place, folders, files in walk(path, **how):
            if Path(place) == tmp_path / "b":  # root may list every folder
                onerror(PermissionError(errno.EACCES, "Permission denied", place))
            else:
                yield place, folders, files

    monkeypatch.setattr(os, "walk", refused)
    first, second = open_source(tmp_path)
    assert first.load().frame == capture.frame
    with pytest.raises(CaptureError, match=r"/b: cannot be read \(Permission denied\); check who"):
        second.load()
    with pytest.raises(CaptureError, match="cannot be read"):
        open_source(tmp_path / "b")
