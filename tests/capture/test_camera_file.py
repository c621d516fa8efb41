from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.camera_file import read_camera_file
from cucumbervision.capture.intrinsics import Intrinsics, Stream
from cucumbervision.errors import CaptureError, IntrinsicsError
from cucumbervision.tube.camera import Distortion

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
