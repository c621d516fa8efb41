"""Depth along the ray, depth of fewer pixels than colour, and colour aligned to depth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.capsules import CAMERA, capsule_capture, lying

from cucumbervision import measure
from cucumbervision.capture.frames import Capture, Doubt
from cucumbervision.capture.intrinsics import DepthAlong, Intrinsics, Stream
from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.errors import CaptureError, IntrinsicsError

CAPSULE = lying(0.20, across_m=0.12, down_m=0.1)


def write_pair(
    folder: Path, capture: Capture, depth_mm: Any = None, camera: Intrinsics = CAMERA, **keys: Any
) -> Path:
    """Write a capture as a pair of pictures with a camera file that has further keys."""
    folder.mkdir(parents=True, exist_ok=True)
    if depth_mm is None:
        depth_mm = 1000 * capture.depth_m
    write_png(folder / "color_1.png", capture.color)
    write_png(folder / "depth_1.png", np.rint(depth_mm).astype(np.uint16))
    block: dict[str, Any] = {"width": camera.width, "height": camera.height}
    block |= {"fx": camera.fx_px, "fy": camera.fy_px, "cx": camera.cx_px, "cy": camera.cy_px}
    block["stream"] = camera.stream
    (folder / "intrinsics.json").write_text(json.dumps(block | keys))
    return folder


def load(folder: Path, **options: Any) -> Capture:
    (ref,) = open_source(folder, ReadOptions(**options))
    return ref.load()


def length_m(read: Capture, drawn: Capture) -> float:
    """Return the length of the one fruit of a capture, by the mask that was drawn with it."""
    (fruit,) = measure(replace(read, masks=drawn.masks), instances="dataset").fruit
    assert fruit.length is not None
    return float(fruit.length.value_m)


def along_rays_mm(capture: Capture) -> Any:
    """Return the distance of each pixel's point from the camera's centre, millimetres."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    x, y = (u - CAMERA.cx_px) / CAMERA.fx_px, (v - CAMERA.cy_px) / CAMERA.fy_px
    return 1000 * capture.depth_m * np.sqrt(x**2 + y**2 + 1)


@pytest.mark.parametrize("door", ["key", "option"])
def test_distance_along_the_ray_becomes_depth_along_the_axis(door: str, tmp_path: Path) -> None:
    drawn = capsule_capture(CAPSULE)
    rays_mm = along_rays_mm(drawn)
    believed = load(write_pair(tmp_path / "believed", drawn, rays_mm))
    assert abs(length_m(believed, drawn) - CAPSULE.length_m) > 0.02 * CAPSULE.length_m
    keys: dict[str, Any] = {"depth_along": "ray"} if door == "key" else {}
    told = {"depth_along": DepthAlong.RAY} if door == "option" else {}
    read = load(write_pair(tmp_path / door, drawn, rays_mm, **keys), **told)
    np.testing.assert_allclose(read.depth_m, drawn.depth_m, atol=0.0006)
    assert length_m(read, drawn) == pytest.approx(CAPSULE.length_m, rel=0.01)


def test_distance_along_the_ray_in_a_native_folder(tmp_path: Path) -> None:
    drawn = capsule_capture(CAPSULE)
    rays_m = (along_rays_mm(drawn) / 1000).astype(np.float32)
    write_native(replace(drawn, depth_m=rays_m), tmp_path / "a")
    file = write_pair(tmp_path / "pair", drawn, depth_along="ray") / "intrinsics.json"
    options: dict[str, Any]
    for options in ({"depth_along": DepthAlong.RAY}, {"intrinsics": file}):
        read = load(tmp_path / "a", **options)
        np.testing.assert_allclose(read.depth_m, drawn.depth_m, atol=0.0006)


def test_colour_aligned_to_depth_has_the_depth_cameras_intrinsics(tmp_path: Path) -> None:
    drawn = capsule_capture(CAPSULE)
    depth_camera = replace(CAMERA, stream=Stream.DEPTH)
    folder = write_pair(tmp_path, drawn, camera=depth_camera)
    with pytest.raises(IntrinsicsError, match="--aligned-to depth"):
        load(folder)
    read = load(folder, aligned_to=Stream.DEPTH)
    assert read.intrinsics == CAMERA
    assert length_m(read, drawn) == pytest.approx(CAPSULE.length_m, rel=0.01)
    assert load(write_pair(tmp_path, drawn, camera=depth_camera, aligned_to="depth")).width == 640


def test_of_both_cameras_that_of_depth_counts(tmp_path: Path) -> None:
    drawn = capsule_capture(CAPSULE)
    block = {"width": 640, "height": 360, "fx": 462, "fy": 462, "cx": 319.5, "cy": 179.5}
    moved = {"rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation_m": [0.015, 0, 0]}
    color_camera = replace(CAMERA, width=1280, height=720, fx_px=927.0, fy_px=927.0, cx_px=640.0)
    keys = {"depth": block, "depth_to_color": moved, "aligned_to": "depth"}
    read = load(write_pair(tmp_path, drawn, camera=replace(color_camera, cy_px=360.0), **keys))
    assert read.intrinsics == CAMERA
    np.testing.assert_allclose(read.depth_m, drawn.depth_m, atol=0.0006)


def test_depth_of_fewer_pixels_counts_where_it_is_said_to_be_aligned(tmp_path: Path) -> None:
    fine = Intrinsics(1280, 720, 924.0, 924.0, 639.5, 359.5)
    drawn, coarse = capsule_capture(CAPSULE, camera=fine), capsule_capture(CAPSULE)
    folder = write_pair(tmp_path, drawn, 1000 * coarse.depth_m, fine)
    with pytest.raises(CaptureError, match="--aligned-to color"):
        load(folder)
    read = load(folder, aligned_to=Stream.COLOR)
    assert read.depth_m.shape == (720, 1280)
    assert read.doubts == (Doubt.DEPTH_RESAMPLED,)
    assert length_m(read, drawn) == pytest.approx(CAPSULE.length_m, rel=0.02)


def test_a_scene_says_its_depth_by_option(tmp_path: Path) -> None:
    drawn = capsule_capture(CAPSULE)
    for kind, picture in (("rgb", drawn.color), ("depth", np.rint(along_rays_mm(drawn)))):
        (tmp_path / kind).mkdir()
        pixels = picture if kind == "rgb" else picture.astype(np.uint16)
        write_png(tmp_path / kind / "000000.png", pixels)
    camera = {"cam_K": CAMERA.matrix.ravel().tolist(), "depth_scale": 1.0}
    (tmp_path / "scene_camera.json").write_text(json.dumps({"0": camera}))
    read = load(tmp_path, depth_along=DepthAlong.RAY)
    np.testing.assert_allclose(read.depth_m, drawn.depth_m, atol=0.0006)
