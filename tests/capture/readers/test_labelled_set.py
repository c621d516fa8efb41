from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.errors import CaptureError

CAMERA = {"width": 64, "height": 48, "fx": 60.5, "fy": 60.25, "cx": 31.5, "cy": 24.5}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A set of two pictures; picture n reads 500 + n tenths of a millimetre."""
    images = []
    for name in ("images", "depth"):
        (tmp_path / name).mkdir()
    for n in range(2):
        write_png(tmp_path / f"images/{n:06d}.png", np.full((48, 64, 3), 90 + n, np.uint8))
        write_png(tmp_path / f"depth/{n:06d}.png", np.full((48, 64), 5000 + n, np.uint16))
        files = {"file_name": f"images/{n:06d}.png", "depth_file": f"depth/{n:06d}.png"}
        camera = {**CAMERA, "cx": 31.5 + n, "stream": "color"}
        images.append({**files, "depth_unit_m": 0.0001, "camera": camera, "source": "synth"})
    write(tmp_path, images)
    return tmp_path


def write(folder: Path, images: Any) -> None:
    (folder / "annotations.json").write_text(json.dumps({"images": images, "annotations": []}))


def change(folder: Path, **values: Any) -> None:
    images = json.loads((folder / "annotations.json").read_text())["images"]
    write(folder, [{**images[0], **values}, *images[1:]])


def test_each_picture_has_its_own_camera(folder: Path) -> None:
    source = open_source(folder)
    assert (source.kind, source.total, source.unused) == ("set", 2, ())
    captures = [ref.load() for ref in source]
    assert [c.intrinsics.cx_px for c in captures] == [31.5, 32.5]
    assert [float(c.depth_m[0, 0]) for c in captures] == pytest.approx([0.5, 0.5001])
    assert [int(c.color[0, 0, 0]) for c in captures] == [90, 91]
    assert [c.simulated for c in captures] == [True, True]
    assert captures[0].name == f"{folder.name}_000000"
    assert (
        next(iter(open_source(folder, ReadOptions(depth_unit_m=0.001)))).load().depth_m[0, 0] == 5
    )


def test_a_set_below_a_folder_is_found(folder: Path) -> None:
    (folder / "a").mkdir()
    for name in ("images", "depth", "annotations.json"):
        (folder / name).rename(folder / "a" / name)
    assert [ref.load().name for ref in open_source(folder)] == [
        f"{folder.name}_a_00000{n}" for n in range(2)
    ]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"file_name": "../outside.png"},
            "outside.png: is not there, which annotations.json names",
        ),
        ({"depth_file": "/etc/passwd"}, "is not there"),
        ({"depth_file": "depth/7.png"}, "is not there"),
        ({"camera": {**CAMERA, "stream": "color", "fx": -1}}, "annotations.json"),
        ({"camera": {**CAMERA, "stream": "color", "width": 640}}, "640"),
        ({"depth_unit_m": "x"}, "depth_unit_m"),
    ],
)
def test_what_a_picture_lacks_is_said_and_the_others_are_read(
    values: dict[str, Any], words: str, folder: Path
) -> None:
    write_png(folder.parent / "outside.png", np.zeros((48, 64, 3), np.uint8))
    change(folder, **values)
    first, second = open_source(folder)
    with pytest.raises(CaptureError, match=words):
        first.load()
    assert second.load().frame == 1


@pytest.mark.parametrize("images", [None, 7, ["x"], [{"file_name": "images/000000.png"}]])
def test_labels_without_depth_are_no_set(images: Any, folder: Path) -> None:
    write(folder, images)
    with pytest.raises(CaptureError, match="holds no captures that can be recognised"):
        open_source(folder)
    (folder / "annotations.json").write_text("{")
    with pytest.raises(CaptureError, match="holds no captures that can be recognised"):
        open_source(folder)


def test_what_changes_a_capture_changes_its_parts(folder: Path) -> None:
    def parts() -> list[list[bytes | Path]]:
        refs = list(open_source(folder))
        return [list(ref.parts()) for ref in refs if ref.parts is not None]

    before = parts()
    change(folder, depth_unit_m=0.001)
    after = parts()
    assert (before[0] != after[0], before[1] == after[1]) == (True, True)
    assert before[0][1:] == [folder / f"{kind}/000000.png" for kind in ("images", "depth")]
