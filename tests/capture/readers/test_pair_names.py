"""Which files are a pair, whose intrinsics they get, and what is no picture of a capture."""

from __future__ import annotations

import json
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers import common, open_source
from cucumbervision.capture.readers.pair import match_pairs
from cucumbervision.capture.source import Folder
from cucumbervision.errors import CaptureError, DepthError, IntrinsicsError

FX_PX = 60.0


def write_camera(path: Path, fx_px: float = FX_PX) -> None:
    size = {"stream": "color", "width": 64, "height": 48, "cx": 31.5, "cy": 23.5}
    path.write_text(json.dumps(size | {"fx": fx_px, "fy": fx_px}), encoding="utf-8")


def write_pair(color: Path, depth: Path, depth_mm: int) -> None:
    for path in (color, depth):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_png(color, np.full((48, 64, 3), 90, np.uint8))
    write_png(depth, np.full((48, 64), depth_mm, np.uint16))


def captures(folder: Path) -> dict[str, Capture]:
    return {ref.name: ref.load() for ref in open_source(folder)}


def depths_m(folder: Path) -> dict[str, float]:
    return {name: float(c.depth_m[0, 0]) for name, c in captures(folder).items()}


def test_letters_of_every_script_tell_pairs_apart(tmp_path: Path) -> None:
    write_camera(tmp_path / "intrinsics.json")
    for name, depth_mm in (
        ("Süd", 400),
        ("Söd", 500),
        ("左", 600),
        ("右", 700),
        ("a+", 800),
        ("a", 900),
    ):
        write_pair(tmp_path / f"{name}_color.png", tmp_path / f"{name}_depth.png", depth_mm)
    found = depths_m(tmp_path)
    assert found == pytest.approx(
        {"Süd_color": 0.4, "Söd_color": 0.5, "左_color": 0.6, "右_color": 0.7, "a__color": 0.8}
        | {"a_color": 0.9}
    )


def test_colour_and_depth_of_two_folders_are_no_pair(tmp_path: Path) -> None:
    write_camera(tmp_path / "intrinsics.json")
    write_png(tmp_path / "color_1.png", np.zeros((48, 64, 3), np.uint8))
    for name, kind in (("左", "color"), ("右", "depth")):
        (tmp_path / name).mkdir()
        (tmp_path / "color_1.png").unlink(missing_ok=True)
        write_png(tmp_path / name / f"{kind}_1.png", np.full((48, 64), 500, np.uint16))
    with pytest.raises(CaptureError, match="no captures that can be recognised"):
        open_source(tmp_path)


@pytest.mark.parametrize("folder", ["depthcam_house3", "rgbd/walk", "color-depth", "深度depth"])
def test_the_files_own_name_tells_its_role_before_folders(tmp_path: Path, folder: str) -> None:
    write_camera(tmp_path / "intrinsics.json")
    write_pair(tmp_path / folder / "color_1.png", tmp_path / folder / "depth_1.png", 500)
    assert depths_m(tmp_path) == pytest.approx({"color_1": 0.5})


def test_a_capture_is_called_as_its_file_is(tmp_path: Path) -> None:
    write_camera(tmp_path / "intrinsics.json")
    write_pair(tmp_path / "d2__1.png", tmp_path / "d2__1_depth.png", 500)
    write_pair(tmp_path / "_x_.png", tmp_path / "_x__depth.png", 600)
    assert depths_m(tmp_path) == pytest.approx({"d2__1": 0.5, "_x_": 0.6})


def test_what_systems_put_beside_pictures_is_passed_over(tmp_path: Path) -> None:
    write_camera(tmp_path / "intrinsics.json")
    write_pair(tmp_path / "color_1.png", tmp_path / "depth_1.png", 500)
    for name in ("._color_1.png", "._depth_1.png", "__MACOSX/color_1.png", "@eaDir/depth_1.png"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"\x00\x05\x16\x07")
    assert depths_m(tmp_path) == pytest.approx({"color_1": 0.5})


def test_each_picture_gets_the_intrinsics_that_begin_as_its_name(tmp_path: Path) -> None:
    for number, fx_px in ((1, 60.0), (2, 80.0), (12, 100.0)):
        write_camera(tmp_path / f"cam{number}_intrinsics.json", fx_px)
        stem = tmp_path / f"cam{number}_color_1.png", tmp_path / f"cam{number}_depth_1.png"
        write_pair(*stem, 500)
    found = {name: c.intrinsics.fx_px for name, c in captures(tmp_path).items()}
    assert found == {"cam1_color_1": 60.0, "cam2_color_1": 80.0, "cam12_color_1": 100.0}


def test_another_cameras_intrinsics_are_not_taken(tmp_path: Path) -> None:
    write_camera(tmp_path / "cam1_intrinsics.json")
    for name in ("cam1", "cam2"):
        write_pair(tmp_path / f"{name}_color_1.png", tmp_path / f"{name}_depth_1.png", 500)
    first, second = open_source(tmp_path)
    assert first.load().intrinsics.fx_px == FX_PX
    with pytest.raises(IntrinsicsError, match="carries no camera intrinsics"):
        second.load()


def test_two_cameras_whose_names_tell_nothing_are_refused(tmp_path: Path) -> None:
    write_pair(tmp_path / "color_1.png", tmp_path / "depth_1.png", 500)
    write_camera(tmp_path / "left_camera.json")
    write_camera(tmp_path / "right_camera.json")
    assert captures(tmp_path)["color_1"].intrinsics.fx_px == FX_PX  # both say the same
    write_camera(tmp_path / "right_camera.json", 80.0)
    with pytest.raises(IntrinsicsError, match="hold different cameras"):
        open_source(tmp_path)


def test_aligned_depth_has_the_intrinsics_of_its_frame(tmp_path: Path) -> None:
    write_pair(tmp_path / "color_1.png", tmp_path / "depth_1.png", 500)
    info = {
        "header": {"frame_id": "camera_color_optical_frame"},
        **{"height": 48, "width": 64, "distortion_model": "plumb_bob", "d": [0.0] * 5},
        "k": [FX_PX, 0, 31.5, 0, FX_PX, 23.5, 0, 0, 1],
    }
    path = tmp_path / "aligned_depth_to_color_camera_info.json"
    path.write_text(json.dumps(info))
    expected = Intrinsics(64, 48, FX_PX, FX_PX, 31.5, 23.5)
    assert captures(tmp_path)["color_1"].intrinsics == expected
    info["header"] = {"frame_id": "camera_depth_optical_frame"}
    path.write_text(json.dumps(info))
    with pytest.raises(IntrinsicsError, match="depth stream's"):
        captures(tmp_path)


def test_depth_of_several_pages_is_refused(tmp_path: Path) -> None:
    write_camera(tmp_path / "intrinsics.json")
    write_pair(tmp_path / "color_1.png", tmp_path / "depth_1.png", 500)
    (tmp_path / "depth_1.png").unlink()
    pages = [np.full((48, 64), depth_mm, np.uint16) for depth_mm in (400, 500, 600)]
    assert cv2.imwritemulti(str(tmp_path / "depth_1.tif"), pages)
    with pytest.raises(DepthError, match=r"depth_1\.tif: holds 3 pages"):
        captures(tmp_path)


@pytest.mark.parametrize(
    "row",
    [
        ";".join(["0,4832"] * 64),
        "\t".join(["0.4832"] * 64),
        "\t".join(["0,4832"] * 64),
        ",".join(["0.4832"] * 64),
        ";".join(["0.4832"] * 64),
    ],
)
def test_depth_tables_are_read_as_they_are_written(tmp_path: Path, row: str) -> None:
    write_camera(tmp_path / "intrinsics.json")
    write_pair(tmp_path / "color_1.png", tmp_path / "depth_1.png", 500)
    (tmp_path / "depth_1.png").unlink()
    (tmp_path / "depth_1.csv").write_text("\n".join([row] * 48) + "\n")
    assert depths_m(tmp_path) == pytest.approx({"color_1": 0.4832})


def test_looking_for_cameras_takes_steps_in_proportion_to_the_files(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = Mock(side_effect=common._stem_words)
    monkeypatch.setattr(common, "_stem_words", words)
    for number in (100, 200):
        names = [f"{kind}_{k}.png" for kind in ("color", "depth") for k in range(number)]
        cameras = [f"{k}_camera.json" for k in range(number)]
        words.reset_mock()
        folder = Folder(Path("walk"), {"": [*names, *cameras]})
        monkeypatch.setattr(common, "_only", lambda _folder, files: files[0] if files else None)
        assert len(match_pairs(folder)) == number
        assert words.call_count < 6 * number
