"""Intrinsics as other programs write them: all of one camera."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cucumbervision.capture.camera_file import read_camera_file
from cucumbervision.capture.intrinsics import Stream
from cucumbervision.errors import IntrinsicsError
from cucumbervision.geometry.camera import Distortion

ROWS = [60.5, 0.0, 31.5, 0.0, 60.25, 24.5, 0.0, 0.0, 1.0]
COLUMNS = [60.5, 0.0, 0.0, 0.0, 60.25, 0.0, 31.5, 24.5, 1.0]
LENS = [0.1, -0.05, 0.001, -0.002, 0.01]
SIZE = {"width": 64, "height": 48}
ROS = f"""header:
  frame_id: camera_color_optical_frame
height: 48
width: 64
distortion_model: plumb_bob
D: {LENS}
K: {ROWS}
"""
ROS_CALIBRATION = f"""image_width: 64
image_height: 48
camera_name: head
camera_matrix: {{rows: 3, cols: 3, data: {ROWS}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {LENS}}}
"""
REALSENSE = {**SIZE, "fx": 60.5, "fy": 60.25, "ppx": 31.5, "ppy": 24.5, "coeffs": LENS}
REALSENSE |= {"model": "distortion.brown_conrady", "stream": "color"}
TEXTS = {
    "open3d.json": json.dumps({**SIZE, "intrinsic_matrix": COLUMNS}),
    "parameters.json": json.dumps({"intrinsic": {**SIZE, "intrinsic_matrix": COLUMNS}}),
    "message.yaml": ROS,
    "message.json": json.dumps({**SIZE, "K": ROWS, "D": LENS}),
    "ost.yaml": ROS_CALIBRATION,
    "realsense.json": json.dumps(REALSENSE),
    "color_intrinsics.json": json.dumps({k: v for k, v in REALSENSE.items() if k != "stream"}),
    "color.txt": f"[ 64x48  p[31.5 24.5]  f[60.5 60.25]  Brown Conrady {LENS} ]".replace(",", ""),
    "streams.json": json.dumps(
        {
            "color": {k: v for k, v in REALSENSE.items() if k != "stream"},
            "depth": {**REALSENSE, "fx": 40.0, "fy": 40.0},
            "depth_scale": 0.001,
        }
    ),
    "transforms.json": json.dumps(
        {
            **{"fl_x": 60.5, "fl_y": 60.25, "cx": 31.5, "cy": 24.5, "w": 64, "h": 48},
            **dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True)),
            "camera_model": "OPENCV",
            "frames": [],
        }
    ),
    "camchain.yaml": "cam0: {camera_model: pinhole, intrinsics: [60.5, 60.25, 31.5, 24.5], "
    "distortion_model: none, resolution: [64, 48], rostopic: /cam0/image}\n",
    "slam.yaml": "%YAML:1.0\nCamera.fx: 60.5\nCamera.fy: 60.25\nCamera.cx: 31.5\n"
    "Camera.cy: 24.5\nCamera.width: 64\nCamera.height: 48\nDepthMapFactor: 1000.0\n",
    "cameras.txt": "# one line a camera\n1 PINHOLE 64 48 60.5 60.25 32.0 25.0\n",
    "record3d.json": json.dumps({"K": COLUMNS, "w": 64, "h": 48}),
    "cam_K.txt": "60.5 0 31.5\n0 60.25 24.5\n0 0 1\n",
    "intrinsic_color.txt": "60.5 0 31.5 0\n0 60.25 24.5 0\n0 0 1 0\n0 0 0 1\n",
    "matrix.json": json.dumps([ROWS[:3], ROWS[3:6], ROWS[6:]]),
    "commas.txt": "60.5, 0, 31.5, 0, 60.25, 24.5, 0, 0, 1",
}
NERF = TEXTS["transforms.json"]
UNSIZED = {"cam_K.txt", "intrinsic_color.txt", "matrix.json", "commas.txt"}


def read(path: Path, text: str) -> Any:
    path.write_text(text)
    return read_camera_file(path)


@pytest.mark.parametrize("name", TEXTS)
def test_each_is_the_same_camera(name: str, tmp_path: Path) -> None:
    found = read(tmp_path / name, TEXTS[name])
    camera = found.intrinsics
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (60.5, 60.25, 31.5, 24.5)
    assert camera.stream is Stream.COLOR
    assert found.is_sized == (name not in UNSIZED)
    if found.is_sized:
        assert camera.size == (64, 48)
    if str(LENS[3]) in TEXTS[name]:
        assert camera.distortion is Distortion.BROWN_CONRADY
        assert list(camera.coefficients) == LENS


@pytest.mark.parametrize("name", ["calibration.yml", "calibration.xml", "calibration.json"])
def test_files_that_opencv_wrote(name: str, tmp_path: Path) -> None:
    storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 64)
    storage.write("image_height", 48)
    storage.write("camera_matrix", np.array(ROWS).reshape(3, 3))
    storage.write("distortion_coefficients", np.array([LENS]))
    storage.release()
    camera = read_camera_file(tmp_path / name).intrinsics
    assert (camera.size, camera.fx_px, camera.cy_px) == ((64, 48), 60.5, 24.5)
    assert (camera.distortion, list(camera.coefficients)) == (Distortion.BROWN_CONRADY, LENS)


def test_a_matrix_in_a_file_of_numpy(tmp_path: Path) -> None:
    np.save(tmp_path / "K.npy", np.array(ROWS).reshape(3, 3))
    camera = read_camera_file(tmp_path / "K.npy").intrinsics
    assert (camera.fx_px, camera.cy_px) == (60.5, 24.5)
    np.save(tmp_path / "names.npy", np.array(["a"] * 9))
    with pytest.raises(IntrinsicsError, match=r"names\.npy"):
        read_camera_file(tmp_path / "names.npy")


def test_the_unit_of_depth_comes_with_the_streams_and_slams_factor(tmp_path: Path) -> None:
    for name in ("streams.json", "slam.yaml"):
        assert read(tmp_path / name, TEXTS[name]).depth_unit_m == 0.001


def test_of_several_cameras_the_colour_camera_counts_where_it_is_told(tmp_path: Path) -> None:
    other = TEXTS["camchain.yaml"].replace("cam0", "cam1").replace("60.5", "90.5")
    with pytest.raises(IntrinsicsError, match="several cameras"):
        read(tmp_path / "camchain.yaml", TEXTS["camchain.yaml"] + other)
    told = TEXTS["camchain.yaml"].replace("/cam0/image", "/color/image")
    assert read(tmp_path / "camchain.yaml", told + other).intrinsics.fx_px == 60.5
    with pytest.raises(IntrinsicsError, match="holds 2 cameras"):
        read(tmp_path / "cameras.txt", TEXTS["cameras.txt"] + "2 PINHOLE 64 48 50 50 32 25\n")


@pytest.mark.parametrize("name", ["depth_camera.yaml", "infra1.yaml", "ir.yaml"])
def test_a_name_may_say_that_it_is_not_the_colour_camera(name: str, tmp_path: Path) -> None:
    text = ROS.replace("camera_color_optical_frame", "")
    assert read(tmp_path / name, text).intrinsics.stream is Stream.DEPTH


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.yaml", ROS.replace("plumb_bob", "equidistant"), "another than plumb_bob"),
        ("a.yaml", ROS.replace("0.01]", "0.01, 0.2, 0.0, 0.0]"), "more than five coefficients"),
        ("a.yaml", ROS.replace("plumb_bob", "equidistant").replace(str(LENS), "[]"), "another"),
        (
            "a.json",
            NERF.replace("OPENCV", "OPENCV_FISHEYE"),
            "another",
        ),
        ("a.json", NERF.replace('"frames"', '"is_fisheye": true, "frames"'), "another"),
        ("a.json", NERF.replace('"frames"', '"k4": 0.3, "frames"'), "more than five"),
        ("a.yaml", f"{TEXTS['slam.yaml']}Camera.type: KannalaBrandt8\n", "another"),
        ("a.yaml", f"fisheye_model: 1\n{ROS}", "another"),
        ("a.yaml", "K: &a [*a, *a]", "entities or anchors"),
        ("a.xml", '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "entities or anchors"),
        ("a.xml", "<a", "is damaged"),
        ("a.yaml", "K: [", "is damaged"),
        ("a.txt", "60 0 31", "camera matrix is not"),
        ("a.txt", "sixty", "is damaged"),
        ("a.txt", "60 0 inf 0 60 24 0 0 1", "camera matrix is not"),
        ("a.json", json.dumps({**SIZE, "intrinsic_matrix": "x"}), "is damaged"),
        ("a.json", json.dumps({"intrinsic": [1, 2]}), "is damaged"),
        (
            "a.json",
            json.dumps({k: v for k, v in REALSENSE.items() if k != "stream"}),
            "does not say which stream",
        ),
    ],
)
def test_what_is_refused(name: str, text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(IntrinsicsError, match=rf"{name}: .*{words}"):
        read(tmp_path / name, text)
