"""The page on captures: its examples are run, its JSON is read."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from cucumbervision.capture.camera_file import read_camera_file
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers.native import Manifest, write_native
from cucumbervision.cli.app import app

DEPTH_MM = np.full((48, 64), 450, np.uint16)
COLOR = np.full((48, 64, 3), 90, np.uint8)
CAMERA = {"stream": "color", "width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 32, "cy": 24}
NOT_MADE_HERE = ("walk.bag", "s3://", "stream camera", "--follow")

PAGE = Path(__file__).parents[2] / "docs" / "captures.md"


def test_json_blocks(tmp_path: Path) -> None:
    blocks = re.findall(r"```json\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    kinds = []
    for block in blocks:
        data = json.loads(block)
        if "format" in data:
            kinds.append("capture")
            Manifest.model_validate(data)
        else:
            kinds.append("intrinsics")
            (tmp_path / "k.json").write_text(block)
            assert read_camera_file(tmp_path / "k.json").intrinsics.size == (1280, 720)
    assert sorted(kinds) == ["capture"] + ["intrinsics"] * 3


def made_samples(folder: Path) -> None:
    """Write a sample of each source under the name that the page's table gives it."""
    matrix = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    for name in ("scene/rgb", "scene/depth", "scene/mask_visib"):
        (folder / name).mkdir(parents=True)
    for name in ("pairs", "loose", "fine", "tables", "viewer"):
        (folder / name).mkdir()
    mask = np.zeros((48, 64), bool)
    mask[20:28, 10:50] = True
    depth_m = (DEPTH_MM / 1000).astype(np.float32)
    lens = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    write_native(Capture(COLOR, depth_m, lens, "one", masks=(mask,)), folder / "captures/one")
    names = ("one", "scene_000000", "rgb_7", "rgb", "color_7", "row3")
    size = {"width": 64, "height": 48}
    coco = {
        "images": [{"id": k, "file_name": f"{n}.png", **size} for k, n in enumerate(names)],
        "categories": [{"id": 1, "name": "cucumber"}],
        "annotations": [
            {"id": k, "image_id": k, "category_id": 1, "bbox": [10, 20, 40, 8]}
            for k in range(len(names))
        ],
    }
    (folder / "masks.json").write_text(json.dumps(coco))
    pictures: dict[str, NDArray[Any]] = {
        "rgb.png": COLOR, "depth.png": DEPTH_MM,
        "scene/rgb/000000.png": COLOR, "scene/depth/000000.png": DEPTH_MM,
        "pairs/rgb_7.png": COLOR, "pairs/depth_7.png": DEPTH_MM,
        "loose/rgb_7.png": COLOR, "loose/depth_7.png": DEPTH_MM,
        "fine/rgb_7.png": COLOR, "fine/depth_7.png": 10 * DEPTH_MM,
        "tables/color_7.png": COLOR,
        "viewer/row3_Color.png": COLOR,
    }  # fmt: skip
    for name, picture in pictures.items():
        write_png(folder / name, picture)
    frame = {"0": {"cam_K": matrix.ravel().tolist(), "depth_scale": 1.0}}
    (folder / "scene/scene_camera.json").write_text(json.dumps(frame))
    for name in ("pairs", "fine", "tables"):
        (folder / name / "camera.json").write_text(json.dumps(CAMERA))
    np.savetxt(folder / "tables/depth_7.csv", DEPTH_MM, fmt="%d", delimiter=",")
    (folder / "viewer/row3_Depth.raw").write_bytes(DEPTH_MM.astype("<u2").tobytes())
    depth_camera = {key: CAMERA[key] for key in ("width", "height", "fx", "fy", "cx", "cy")}
    turn = {"rotation": np.eye(3).tolist(), "translation_m": [0.015, 0, 0]}
    both = CAMERA | {"depth": depth_camera, "depth_to_color": turn}
    (folder / "both.json").write_text(json.dumps(both))
    said: dict[str, object] = {
        "Frame Number": 1,
        "Resolution x": 64,
        "Resolution y": 48,
        "Bytes per pixel": 2,
    }
    said |= {"Type": "Depth", "Format": "Z16", "Fx": 60, "Fy": 60, "PPx": 32, "PPy": 24}
    table = "Frame Info:\n" + "".join(f"{key},{value}\n" for key, value in said.items())
    (folder / "viewer/row3_Depth_metadata.csv").write_text(table)


def table_commands() -> list[str]:
    rows = re.findall(r"^\|.*\| `(cucumbervision .*)` \|$", PAGE.read_text("utf-8"), re.MULTILINE)
    return [row for row in rows if not any(word in row for word in NOT_MADE_HERE)]


@pytest.mark.parametrize("command", table_commands())
def test_what_the_table_says_to_type_reads_a_sample(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_samples(tmp_path)
    monkeypatch.chdir(tmp_path)
    # With boxes from a file no network is loaded, which is not what the table is about.
    boxes = ["--instances", "masks.json", "--segmenter", "none"]
    found = CliRunner().invoke(app, [*command.split()[1:], *boxes])
    assert found.exit_code == 0, found.output
    lines = Path("run/measurements.csv").read_text("utf-8-sig").splitlines()
    (row,) = csv.DictReader(lines)
    # 40 pixels at 0.45 m and 60 pixels of focal length.
    assert float(row["length_cm"]) == pytest.approx(30.0)


def test_the_table_has_a_row_a_source() -> None:
    assert len(table_commands()) == 9
