from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.camera_file import read_camera_file
from cucumbervision.capture.intrinsics import Distortion, Intrinsics, Stream
from cucumbervision.capture.readers.common import choose_intrinsics
from cucumbervision.errors import CaptureError, DepthError, IntrinsicsError

OURS = {
    "stream": "color",
    "width": 1280,
    "height": 720,
    "fx": 910.5,
    "fy": 909.8,
    "cx": 645.2,
    "cy": 366.1,
}
MATRIX: list[list[float]] = [[910.5, 0, 645.2], [0, 909.8, 366.1], [0, 0, 1]]
COLOR = Intrinsics(1280, 720, 910.5, 909.8, 645.2, 366.1)
DEPTH = {k: v for k, v in OURS.items() if k != "stream"} | {"fx": 640.0, "fy": 640.0}


def write(folder: Path, data: Any) -> Path:
    path = folder / "k.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def without(*keys: str) -> dict[str, Any]:
    return {k: v for k, v in OURS.items() if k not in keys}


@pytest.mark.parametrize(
    "data",
    [
        OURS,
        {"stream": "color", "width": 1280, "height": 720, "matrix": MATRIX},
        {
            "stream": "color",
            "width": 1280,
            "height": 720,
            "matrix": [n for row in MATRIX for n in row],
        },
    ],
)
def test_the_forms_that_are_read(data: dict[str, Any], tmp_path: Path) -> None:
    calibration = read_camera_file(write(tmp_path, data))
    assert calibration.intrinsics == COLOR
    assert calibration.depth_unit_m is None
    assert calibration.depth_to_color is None


def test_lens_and_stream(tmp_path: Path) -> None:
    data = OURS | {
        "stream": "depth",
        "distortion": "inverse_brown_conrady",
        "coefficients": [0.1, -0.05, 0.001, -0.002, 0.01],
        "depth_unit_m": 0.0001,
    }
    calibration = read_camera_file(write(tmp_path, data))
    assert calibration.intrinsics.stream is Stream.DEPTH
    assert calibration.intrinsics.distortion is Distortion.INVERSE_BROWN_CONRADY
    assert calibration.intrinsics.coefficients == (0.1, -0.05, 0.001, -0.002, 0.01)
    assert calibration.depth_unit_m == 0.0001


def test_rotation_of_nine_is_column_by_column_and_of_rows_is_rows(tmp_path: Path) -> None:
    turn = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    columns = [0, 1, 0, -1, 0, 0, 0, 0, 1]
    for rotation in (turn, columns):
        data = OURS | {
            "depth": DEPTH,
            "depth_to_color": {"rotation": rotation, "translation_m": [0.015, 0, 0]},
        }
        calibration = read_camera_file(write(tmp_path, data))
        assert calibration.depth is not None
        assert calibration.depth.stream is Stream.DEPTH
        assert calibration.depth_to_color is not None
        np.testing.assert_array_equal(calibration.depth_to_color.rotation, turn)
        assert calibration.depth_to_color.translation_m.tolist() == [0.015, 0, 0]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (without("stream"), 'does not say which stream.*add "stream": "color"'),
        (without("fx"), "'fx': field required"),
        (without("fx", "cx"), r"'fx': field required \(and 1 more\)"),
        (OURS | {"fx": "wide"}, "'fx': input should be a valid number"),
        (OURS | {"fx": -1}, "'fx': input should be greater than 0"),
        (OURS | {"stream": "infrared"}, "'stream': input should be"),
        (OURS | {"distorsion": "none"}, "'distorsion': extra inputs are not permitted"),
        (OURS | {"coefficients": [1, 2]}, "coefficients"),
        (OURS | {"coefficients": [0.1, 0, 0, 0, 0]}, "coefficients need 'distortion'"),
        (without("fx", "fy", "cx", "cy") | {"matrix": [[1, 2], [3, 4]]}, "not \\[\\[fx, 0, cx\\]"),
        (without("fx", "fy", "cx", "cy") | {"matrix": "identity"}, "camera matrix is not"),
        (without("fx", "fy", "cx", "cy") | {"matrix": [10**400] * 9}, "camera matrix is not"),
        (
            {"stream": "color", "matrix": [[60, 0, 1.7e308], [0, 60, 23.5], [0, 0, 1]]},
            "camera matrix is not",
        ),
        (OURS | {"fx": 10**400}, "'fx': input should be a valid number"),
        (OURS | {"width": 10**400}, "is not a picture"),
        *(
            (OURS | wrong, "no camera of 1280x720 pixels has")
            for wrong in (
                {"fx": 1e-300},
                {"fx": 1e300, "fy": 1e300},
                {"fx": 1820.0, "fy": 910.0},
                {"distortion": "none", "coefficients": [0, 0, 0, 0, 1e300]},
            )
        ),
        (
            OURS | {"depth_to_color": {"rotation": [1] * 9, "translation_m": [0, 0, 0]}},
            "is not a rotation",
        ),
        (
            OURS | {"depth_to_color": {"rotation": [[1, 0]], "translation_m": [0, 0, 0]}},
            "is not a rotation",
        ),
        (
            OURS | {"depth_to_color": {"rotation": [[1, 0], [0]], "translation_m": [0, 0, 0]}},
            "'depth_to_color.rotation': ",
        ),
        ([1, 2], "camera matrix is not"),
        (7, "holds no intrinsics"),
    ],
)
def test_what_is_refused(data: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(IntrinsicsError, match=rf"k\.json: .*{words}") as caught:
        read_camera_file(write(tmp_path, data))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [("{", "is not JSON .line 1, column 2"), ("", "is empty"), ('{"fx": NaN', "is not JSON")],
)
def test_what_is_no_json(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=rf"k\.json: .*{words}"):
        read_camera_file(write(tmp_path, text))


ROWS = [60.5, 0.0, 31.5, 0.0, 60.25, 24.5, 0.0, 0.0, 1.0]
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
    "cam_K.txt": "60.5 0 31.5\n0 60.25 24.5\n0 0 1\n",
    "intrinsic_color.txt": "60.5 0 31.5 0\n0 60.25 24.5 0\n0 0 1 0\n0 0 0 1\n",
    "matrix.json": json.dumps([ROWS[:3], ROWS[3:6], ROWS[6:]]),
    "commas.txt": "60.5, 0, 31.5, 0, 60.25, 24.5, 0, 0, 1",
}
UNSIZED = {"cam_K.txt", "intrinsic_color.txt", "matrix.json", "commas.txt"}


def read(path: Path, text: str) -> Any:
    path.write_text(text)
    return read_camera_file(path)


@pytest.mark.parametrize(
    ("key", "scale", "unit_m"),
    [("K", 1000, 0.001), ("K", 0.00025, 0.00025), ("K", 5000.0, 0.0002), ("cam_K", 1e-4, 1e-4)],
)
def test_a_depth_scale_beside_a_matrix_is_metres_a_step_or_steps_a_metre(
    key: str, scale: float, unit_m: float, tmp_path: Path
) -> None:
    text = json.dumps({**SIZE, key: ROWS, "depth_scale": scale})
    assert read(tmp_path / "c.json", text).depth_unit_m == pytest.approx(unit_m)
    for other in (1.0, -1, 0):
        with pytest.raises(IntrinsicsError, match=f"has a depth_scale of {other:g}, neither"):
            read(tmp_path / "c.json", json.dumps({**SIZE, "K": ROWS, "depth_scale": other}))


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


def test_a_matrix_in_a_file_of_numpy(tmp_path: Path) -> None:
    np.save(tmp_path / "K.npy", np.array(ROWS).reshape(3, 3))
    camera = read_camera_file(tmp_path / "K.npy").intrinsics
    assert (camera.fx_px, camera.cy_px) == (60.5, 24.5)
    np.save(tmp_path / "names.npy", np.array(["a"] * 9))
    with pytest.raises(DepthError, match=r"names\.npy: holds no numbers"):
        read_camera_file(tmp_path / "names.npy")


def test_the_unit_of_depth_comes_with_the_streams(tmp_path: Path) -> None:
    assert read(tmp_path / "streams.json", TEXTS["streams.json"]).depth_unit_m == 0.001


@pytest.mark.parametrize(
    ("name", "text", "program"),
    [
        (
            "camera.json",
            json.dumps({**SIZE, "fx": 1, "fy": 1, "cx": 1, "cy": 1, "depth_scale": 1}),
            "BOP",
        ),
        ("open3d.json", json.dumps({"intrinsic": {"intrinsic_matrix": ROWS}}), "Open3D"),
        ("transforms.json", '{"fl_x": 60.5}', "nerfstudio"),
        ("camchain.yaml", "cam0: {camera_model: pinhole}", "Kalibr"),
        ("slam.yaml", "%YAML:1.0\nCamera.fx: 60.5\n", "ORB-SLAM"),
        ("camera.xml", "<opencv_storage/>", "OpenCV"),
        ("cameras.txt", "1 PINHOLE 64 48 60.5 60.25 32.0 25.0\n", "COLMAP"),
    ],
)
def test_files_of_other_programs_are_refused_by_their_name(
    name: str, text: str, program: str, tmp_path: Path
) -> None:
    with pytest.raises(IntrinsicsError, match=rf"is a camera file of {program}; .*plugins\.py"):
        read(tmp_path / name, text)


def test_a_region_of_interest_and_binning_are_taken_out_of_the_matrix(tmp_path: Path) -> None:
    region = "binning_x: 2\nbinning_y: 2\nroi: {x_offset: 8, y_offset: 4, width: 40, height: 32}\n"
    camera = read(tmp_path / "message.yaml", ROS + region).intrinsics
    assert camera.size == (20, 16)
    # The middle of pixel 31.5 lies 24 px right of the region's edge: 12 px of twice the size.
    assert (camera.fx_px, camera.cx_px, camera.cy_px) == (30.25, 11.5, 10.0)


@pytest.mark.parametrize(
    ("source", "fx_px"), [("image_rect/1.png", 55.0), ("image_raw/1.png", 60.5), ("1.png", None)]
)
def test_rectified_pictures_have_p_and_raw_ones_k(
    source: str, fx_px: float | None, tmp_path: Path
) -> None:
    p = "P: [55.0, 0, 31.5, 0, 0, 55.0, 24.5, 0, 0, 0, 1, 0]\n"
    found = read(tmp_path / "message.yaml", ROS + p)
    if fx_px is None:
        with pytest.raises(IntrinsicsError, match=r"P has fx 55 px .*K 60\.5 px .*no name tells"):
            choose_intrinsics(None, found, 64, 48, source=source)
        return
    camera = choose_intrinsics(None, found, 64, 48, source=source)
    assert camera.fx_px == fx_px
    assert any(camera.coefficients) == (fx_px == 60.5)


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
        ("a.yaml", "K: &a [*a, *a]", "has anchors"),
        ("a.yaml", "K: [", "is damaged"),
        ("a.txt", "60 0 31", "camera matrix is not"),
        ("a.txt", "sixty", "is damaged"),
        ("a.txt", "60 0 inf 0 60 24 0 0 1", "camera matrix is not"),
        ("a.json", json.dumps({**SIZE, "K": "x"}), "is damaged"),
        (
            "a.json",
            json.dumps({k: v for k, v in REALSENSE.items() if k != "stream"}),
            "does not say which stream",
        ),
    ],
)
def test_what_other_programs_write_is_refused(
    name: str, text: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(IntrinsicsError, match=rf"{name}: .*{words}"):
        read(tmp_path / name, text)
