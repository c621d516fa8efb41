from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import read_depth, write_png
from cucumbervision.capture.readers import ReadOptions, common, list_folder, open_source
from cucumbervision.capture.readers.pair import Pair, match_pairs
from cucumbervision.capture.source import Folder
from cucumbervision.errors import CaptureError, DepthError, IntrinsicsError

COLOR = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
DEPTH_MM = np.full((48, 64), 450, np.uint16)
CAMERA = {"stream": "color", "width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 32, "cy": 24}
MATRIX = [[60, 0, 32], [0, 60, 24], [0, 0, 1]]


@pytest.fixture
def intrinsics(tmp_path: Path) -> Path:
    path = tmp_path / "k.json"
    path.write_text(json.dumps(CAMERA))
    return path


def load(path: Path, **options: Any) -> Capture:
    (ref,) = open_source(path, ReadOptions(**options))
    return ref.load()


@pytest.mark.parametrize(
    ("name", "depth"),
    [
        ("d.png", DEPTH_MM),
        ("d.tiff", DEPTH_MM),
        ("d.tiff", DEPTH_MM.astype(np.float32) / 1000),
        ("d.npy", DEPTH_MM),
        ("d.npy", DEPTH_MM / 1000),
    ],
)
def test_two_files(name: str, depth: Any, tmp_path: Path, intrinsics: Path) -> None:
    write_png(tmp_path / "c.png", COLOR)
    if name == "d.npy":
        np.save(tmp_path / name, depth)
    else:
        cv2.imwrite(str(tmp_path / name), depth)
    capture = load(tmp_path / "c.png", depth=tmp_path / name, intrinsics=intrinsics)
    np.testing.assert_array_equal(capture.color, COLOR)
    assert np.unique(capture.depth_m).tolist() == [np.float32(0.45)]
    assert (capture.name, capture.intrinsics.fx_px) == ("c", 60)


@pytest.mark.parametrize(
    ("depth", "unit_m", "words"),
    [
        (DEPTH_MM / 1000, 0.001, "declared in millimetres.*in metres"),
        (DEPTH_MM, 1.0, "declared in metres.*in millimetres"),
        (DEPTH_MM.astype(float), None, "declared in metres.*in millimetres"),
        (np.zeros((48, 64)), None, "every pixel is 0"),
        (np.full((48, 64), np.nan), None, "every pixel is 0"),
        (np.full((48, 64), 9, np.uint8), None, "8 bits"),
        (np.array([{}], dtype=object), None, "Object arrays"),
    ],
)
def test_bad_depth(
    depth: Any, unit_m: float | None, words: str, tmp_path: Path, intrinsics: Path
) -> None:
    write_png(tmp_path / "c.png", COLOR)
    np.save(tmp_path / "d.npy", depth, allow_pickle=True)
    with pytest.raises(DepthError, match=rf"d\.npy: .*{words}"):
        load(
            tmp_path / "c.png", depth=tmp_path / "d.npy", intrinsics=intrinsics, depth_unit_m=unit_m
        )


def test_sizes_must_agree(tmp_path: Path, intrinsics: Path) -> None:
    write_png(tmp_path / "c.png", COLOR)
    np.save(tmp_path / "d.npy", DEPTH_MM[:, :60])
    with pytest.raises(CaptureError, match=r"d\.npy: depth is 60x48, colour 64x48"):
        load(tmp_path / "c.png", depth=tmp_path / "d.npy", intrinsics=intrinsics)
    write_png(tmp_path / "c.png", COLOR[:24, :32])
    with pytest.raises(IntrinsicsError, match=r"k\.json: .*64x48, the picture is 32x24.*-50 %"):
        load(tmp_path / "c.png", depth=tmp_path / "d.npy", intrinsics=intrinsics)


def test_intrinsics_are_needed(tmp_path: Path) -> None:
    write_png(tmp_path / "c.png", COLOR)
    np.save(tmp_path / "d.npy", DEPTH_MM)
    with pytest.raises(IntrinsicsError, match=r"c\.png: carries no camera intrinsics"):
        open_source(tmp_path / "c.png", ReadOptions(depth=tmp_path / "d.npy"))
    write_png(tmp_path / "color_1.png", COLOR)
    np.save(tmp_path / "depth_1.npy", DEPTH_MM)
    with pytest.raises(IntrinsicsError, match="carries no camera intrinsics"):
        open_source(tmp_path)


def test_a_color_picture_alone(tmp_path: Path) -> None:
    write_png(tmp_path / "c.png", COLOR)
    with pytest.raises(CaptureError, match=r"c\.png: a colour picture alone has no distances"):
        open_source(tmp_path / "c.png")


def test_a_folder_pairs_by_name(tmp_path: Path, intrinsics: Path) -> None:
    folder = tmp_path / "walk"
    (folder / "colour").mkdir(parents=True)
    (folder / "depth").mkdir()
    write_png(folder / "rgb_7.png", COLOR)
    write_png(folder / "depth_7.png", DEPTH_MM)
    write_png(folder / "depth_map_7.png", np.full((48, 64, 3), 9, np.uint8))
    write_png(folder / "Row3-Color.png", COLOR)
    np.save(folder / "Row3-Depth.npy", DEPTH_MM)
    write_png(folder / "Row3-Depth.png", np.full((48, 64, 3), 9, np.uint8))
    write_png(folder / "colour" / "000.png", COLOR)
    np.save(folder / "depth" / "000.npy", DEPTH_MM)
    write_png(folder / "rgb_8.png", COLOR)
    write_png(folder / "depth_9.png", DEPTH_MM)
    source = open_source(folder, ReadOptions(intrinsics=intrinsics))
    assert (source.kind, source.total) == ("pair", 5)
    refs = {r.name: r for r in source}
    assert set(refs) == {"000", "rgb_7", "Row3-Color", "rgb_8", "depth_9"}
    assert len({r.frame for r in source}) == 5
    for name in ("000", "rgb_7", "Row3-Color"):
        assert refs[name].load().fill == 1.0
    with pytest.raises(CaptureError, match=r"rgb_8\.png: has no depth picture"):
        refs["rgb_8"].load()
    with pytest.raises(CaptureError, match=r"depth_9\.png: has no colour picture"):
        refs["depth_9"].load()


def test_depth_that_is_not_aligned_yet(tmp_path: Path) -> None:
    write_png(tmp_path / "color.png", COLOR)
    depth = np.zeros((24, 32), np.uint16)
    depth[10, 20] = 500
    write_png(tmp_path / "depth.png", depth)
    depth_camera = {"width": 32, "height": 24, "fx": 25, "fy": 25, "cx": 16, "cy": 12}
    extrinsics = {"rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation_m": [0.05, 0, 0]}
    camera = CAMERA | {"depth": depth_camera, "depth_to_color": extrinsics}
    (tmp_path / "intrinsics.json").write_text(json.dumps(camera))
    ys, xs = np.nonzero(load(tmp_path).depth_m)
    # x from 60 (3.5/25 + 0.1) + 32 = 46.4 to 60 (4.5/25 + 0.1) + 32 = 48.8, y from
    # 60 (-2.5/25) + 24 = 18 to 60 (-1.5/25) + 24 = 20.4.
    assert (xs.min(), xs.max(), ys.min(), ys.max()) == (46, 49, 18, 20)
    camera["depth"] = depth_camera | {"width": 30}
    (tmp_path / "intrinsics.json").write_text(json.dumps(camera))
    with pytest.raises(CaptureError, match=r"depth is 32x24, the depth camera's .* 30x24"):
        load(tmp_path)


@pytest.mark.parametrize("name", ["associations.txt", "rgb.txt"])
def test_a_tum_sequence_is_refused_by_its_name(name: str, tmp_path: Path, intrinsics: Path) -> None:
    for part in ("rgb", "depth"):  # names that match, in a unit that no file says
        (tmp_path / "seq" / part).mkdir(parents=True)
        write_png(tmp_path / "seq" / part / "1.1.png", COLOR if part == "rgb" else DEPTH_MM)
    (tmp_path / "seq" / name).touch()
    with pytest.raises(CaptureError, match=r"seq.*txt: a TUM sequence: not .*plugins\.py"):
        open_source(tmp_path, ReadOptions(intrinsics=intrinsics))


def test_arrays_of_both_are_refused_by_their_name(tmp_path: Path, intrinsics: Path) -> None:
    np.savez(tmp_path / "a.npz", color=COLOR, depth=DEPTH_MM, matrix=MATRIX)
    for path in (tmp_path, tmp_path / "a.npz"):
        with pytest.raises(CaptureError, match=r"\.npz files?: not read any more.*plugins\.py"):
            open_source(path)
    write_png(tmp_path / "color_1.png", COLOR)
    write_png(tmp_path / "depth_1.png", DEPTH_MM)
    assert open_source(tmp_path, ReadOptions(intrinsics=intrinsics)).total == 1


@pytest.mark.realdata
def test_greenhouse_foliage(data: Path, tmp_path: Path) -> None:
    given = tmp_path / "k.json"
    given.write_text(json.dumps(CAMERA | {"width": 1280, "height": 720, "fx": 910, "fy": 910}))
    capture = load(data / "rgbd/greenhouse_foliage_d435i", intrinsics=given)
    assert (capture.width, capture.height) == (1280, 720)
    # 18.8 % of the pixels are holes.
    assert (capture.depth_m == 0).mean() == pytest.approx(0.188, abs=0.001)


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        ("sample_06.png", "sample_06_depth.npy"),
        ("a_1_color_clean.png", "a_1_color_clean_depth.npy"),
        ("a_1_color.jpg", "a_1_depth.png"),
    ],
)
def test_usual_names_of_pairs(tmp_path: Path, color: str, depth: str) -> None:
    for name in (color, depth, "mask.png", "notes.txt"):
        (tmp_path / name).touch()
    assert match_pairs(list_folder(tmp_path)) == [Pair(tmp_path / color, tmp_path / depth)]


def test_intrinsics_without_a_size_belong_to_pictures_around_their_centre(tmp_path: Path) -> None:
    write_png(tmp_path / "rgb.png", COLOR)
    write_png(tmp_path / "depth.png", DEPTH_MM)
    (tmp_path / "cam_K.txt").write_text("910 0 640 0 910 360 0 0 1")
    with pytest.raises(IntrinsicsError, match=r"cam_K\.txt: does not say its size, and 640, 360"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("text", "step"),
    [
        ("450,460\n450,nan\n", 1.0),
        *((f"{row}\n" * 2, 1.0) for row in ("0.45;0.46", "0,45;0,46", "0.45\t0.46", "0,45\t0,46")),
        ("450,460\n450,470\n", 0.001),
    ],
)
def test_depth_as_a_table(text: str, step: float, tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text(text)
    read = read_depth(tmp_path / "d.csv")
    assert read.shape == (2, 2)
    assert (read.dtype.kind == "f") == (step == 1.0)
    assert read[0, 1] in (460, 0.46)
    (tmp_path / "d.csv").write_text("1,2\n3\n")
    with pytest.raises(DepthError, match=r"d\.csv: .*"):
        read_depth(tmp_path / "d.csv")


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
