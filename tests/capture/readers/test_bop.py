from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.errors import CaptureError, DepthError, IntrinsicsError

K = [60.5, 0, 31.5, 0, 60.25, 24.5, 0, 0, 1]
SHAPE = (48, 64)


def make_scene(folder: Path, images: tuple[int, ...] = (1, 4, 7), scale: float = 1.0) -> Path:
    """Image n reads 500 + n in every pixel and has n % 3 masks."""
    for part in ("rgb", "depth", "mask_visib"):
        (folder / part).mkdir(parents=True)
    for n in images:
        write_png(folder / f"rgb/{n:06d}.png", np.full((*SHAPE, 3), n, np.uint8))
        write_png(folder / f"depth/{n:06d}.png", np.full(SHAPE, 500 + n, np.uint16))
        for k in range(n % 3):
            mask = np.zeros(SHAPE, np.uint8)
            mask[k, : n + 1] = 255
            write_png(folder / f"mask_visib/{n:06d}_{k:06d}.png", mask)
    cameras = {str(n): {"cam_K": K, "depth_scale": scale} for n in images}
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


def failures(path: Path, **options: Any) -> dict[int, str]:
    """What each image of a source says that cannot be read."""
    found = {}
    for ref in open_source(path, ReadOptions(**options)):
        try:
            ref.load()
        except CaptureError as error:
            found[ref.frame] = str(error)
    return found


def test_scene(tmp_path: Path) -> None:
    source = open_source(make_scene(tmp_path / "greenhouse 3"))
    assert (source.kind, source.total) == ("bop", 3)
    captures = [r.load() for r in source]
    assert [c.name for c in captures] == [f"greenhouse_3_00000{n}" for n in (1, 4, 7)]
    assert [c.frame for c in captures] == [r.frame for r in source] == [1, 4, 7]
    assert [len(c.masks) for c in captures] == [1, 1, 1]
    assert [int(c.masks[0].sum()) for c in captures] == [2, 5, 8]
    assert np.unique(captures[1].depth_m).tolist() == [np.float32(0.504)]
    assert captures[1].intrinsics.matrix.ravel().tolist() == K
    assert captures[1].source.endswith("000004.png")


def test_depth_scale_is_in_millimetres(tmp_path: Path) -> None:
    make_scene(tmp_path / "s", images=(5,), scale=0.1)
    # 505 * 0.1 mm is too near for a reading; in millimetres it would be one.
    assert "declare the depth unit 0.001 m" in failures(tmp_path / "s")[5]
    make_scene(tmp_path / "t", images=(5,), scale=0.5)
    (ref,) = open_source(tmp_path / "t")
    capture = ref.load()
    assert np.unique(capture.depth_m).tolist() == [np.float32(0.2525)]
    assert len(capture.masks) == 2


def test_a_data_set_of_scenes(tmp_path: Path) -> None:
    for scene in ("val/000002", "val/000001"):
        make_scene(tmp_path / "set" / scene, images=(3,))
    names = [r.name for r in open_source(tmp_path / "set")]
    assert names == ["set_val_000001_000003", "set_val_000002_000003"]


def test_one_broken_image_loses_nothing_of_the_rest(tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "s", images=tuple(range(1, 11)))
    (scene / "rgb/000001.png").unlink()
    (scene / "depth/000002.png").unlink()
    data = (scene / "rgb/000003.png").read_bytes()
    (scene / "rgb/000003.png").write_bytes(data[: len(data) // 2])
    write_png(scene / "depth/000004.png", np.zeros(SHAPE, np.uint16))
    write_png(scene / "depth/000005.png", np.full((24, 32), 500, np.uint16))
    write_png(scene / "mask_visib/000006_000000.png", np.zeros((24, 32), np.uint8))
    write_png(scene / "mask_visib/000077_000000.png", np.zeros(SHAPE, np.uint8))
    write_png(scene / "depth/000008.png", np.full(SHAPE, 200, np.uint8))
    cameras = json.loads((scene / "scene_camera.json").read_text())
    del cameras["9"]
    cameras["10"] = {"cam_K": K[:8]}
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    found = failures(scene)
    for frame, words in {
        1: "rgb/000001.png: image 1 is missing",
        2: "depth/000002.png: image 2 is missing",
        3: "rgb/000003.png: is truncated",
        4: "depth/000004.png: depth has no reading",
        5: "depth/000005.png: depth is 32x24, colour 64x48",
        6: "sizes differ: colour 64x48, depth 64x48, mask 0 32x24",
        77: "rgb/000077.png: image 77 is missing",
        8: "depth/000008.png: depth has 8 bits",
        9: "scene_camera.json: has no entry for image 9",
        10: "scene_camera.json: 'cam_K': list should have at least 9 items",
    }.items():
        assert words in found.pop(frame)
    assert found == {}
    assert len(list(open_source(scene))) == 11


@pytest.mark.parametrize(
    ("text", "words"),
    [("{", "is not JSON"), ("[]", "'the whole': input should be a valid dictionary")],
)
def test_a_broken_camera_file(text: str, words: str, tmp_path: Path) -> None:
    make_scene(tmp_path / "set/a", images=(1,))
    make_scene(tmp_path / "set/b", images=(2,))
    (tmp_path / "set/a/scene_camera.json").write_text(text)
    found = failures(tmp_path / "set")
    assert list(found) == [1]
    assert f"a/scene_camera.json: {words}" in found[1]


def test_a_scene_without_images(tmp_path: Path) -> None:
    make_scene(tmp_path / "s", images=())
    with pytest.raises(CaptureError, match=r"s: has no images in rgb/"):
        open_source(tmp_path / "s")


def test_a_matrix_with_skew_is_refused(tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "s", images=(1,))
    skewed = {"1": {"cam_K": [60, 2, 31, 0, 60, 24, 0, 0, 1]}}
    (scene / "scene_camera.json").write_text(json.dumps(skewed))
    assert "scene_camera.json: the camera matrix is not" in failures(scene)[1]


def test_given_unit_goes_before_the_scenes(tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "s", images=(1,))
    (ref,) = open_source(scene, ReadOptions(depth_unit_m=0.002))
    assert np.unique(ref.load().depth_m).tolist() == [np.float32(1.002)]
    with pytest.raises(DepthError, match="declared in metres"):
        next(iter(open_source(scene, ReadOptions(depth_unit_m=1.0)))).load()


@pytest.mark.realdata
def test_carrot_frames(data: Path) -> None:
    source = open_source(data / "rgbd/carrot_realsense_1280")
    captures = [r.load() for r in source]
    assert [c.frame for c in captures] == list(range(1, 29, 3))
    assert {(c.width, c.height) for c in captures} == {(1280, 720)}
    assert {c.intrinsics.fx_px for c in captures} == {927.17}
    assert all(c.fill > 0.98 and len(c.masks) == 1 for c in captures)
    # The carrot lies between 0.34 and 0.52 m.
    distances = [np.median(c.depth_m[c.masks[0] & (c.depth_m > 0)]) for c in captures]
    assert 0.33 < min(distances) < max(distances) < 0.53


@pytest.mark.realdata
def test_depth_stream_matrix_on_carrot_frames_is_refused(data: Path, tmp_path: Path) -> None:
    given = tmp_path / "depth.json"
    given.write_text(
        '{"stream": "depth", "width": 1280, "height": 720,'
        ' "matrix": [[640, 0, 640], [0, 640, 360], [0, 0, 1]]}'
    )
    refs = list(open_source(data / "rgbd/carrot_realsense_1280", ReadOptions(intrinsics=given)))
    assert len(refs) == 10
    for ref in refs:
        # 927.17 / 640 - 1 = 0.449
        with pytest.raises(IntrinsicsError, match=r"depth\.json: .*\+45 %"):
            ref.load()
