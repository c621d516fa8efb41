from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.pictures import read_depth, write_png
from cucumbervision.capture.readers import ReadOptions, list_folder, open_source
from cucumbervision.capture.readers.pair import Pair, match_pairs
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
        (np.array([{}], dtype=object), None, "holds no numbers"),
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
    [("450,460\n450,nan\n", 1.0), ("0.45;0.46\n0.45;0.47\n", 1.0), ("450,460\n450,470\n", 0.001)],
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
