from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CaptureError


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"color": np.zeros((48, 64), np.uint8)}, "colour is uint8 .48, 64."),
        ({"color": np.zeros((48, 64, 3), np.uint16)}, "colour is uint16"),
        ({"depth_m": np.zeros((48, 64))}, "depth is float64"),
        ({"depth_m": np.zeros((48, 64, 1), np.float32)}, "depth is float32 .48, 64, 1."),
        ({"depth_m": np.zeros((48, 60), np.float32)}, "colour 64x48, depth 60x48"),
        ({"masks": (np.zeros((24, 32), bool),)}, "mask 0 32x24"),
        ({"intrinsics": Intrinsics(32, 24, 30, 30, 16, 12)}, "the intrinsics are for 32x24"),
        ({"gravity": (0.0, 0.0, 0.0)}, "gravity .0.0, 0.0, 0.0. is no direction"),
        ({"gravity": (0.0, np.nan, 1.0)}, "is no direction"),
    ],
)
def test_parts_that_disagree(capture: Capture, change: dict[str, Any], words: str) -> None:
    with pytest.raises(CaptureError, match=words):
        replace(capture, **change)


def test_pixels_that_a_masked_array_leaves_out_are_no_readings() -> None:
    depth = np.ma.masked_greater(np.array([[0.5, 0.5, 4.0, 4.0]] * 4), 1.0)
    matrix = np.array([[4.0, 0, 1.9], [0, 4, 1.9], [0, 0, 1]])
    read = Capture.from_arrays(np.zeros((4, 4, 3), np.uint8), depth, matrix)
    assert read.depth_m.tolist() == [[0.5, 0.5, 0.0, 0.0]] * 4
