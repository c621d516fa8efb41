from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.frames import fuse_burst, median_depth, sharpness
from cucumbervision.errors import CaptureError

GREY = np.full((2, 3, 3), 90, np.uint8)


def stack(*values: list[float]) -> list[Any]:
    """One frame a list, each of one row."""
    return [np.array([v], np.float32) for v in values]


def test_median_of_valid_readings_by_hand() -> None:
    nan = float("nan")
    # A column a pixel: all valid; two holes; NaN and too near; only one; too far; none.
    frames = stack(
        [0.50, 0.0, nan, 0.0, 9.0, 0.0],
        [0.52, 0.50, 0.40, 0.0, 0.50, 0.05],
        [0.51, 0.0, 0.42, 0.0, 9.0, 5.01],
        [0.90, 0.60, 0.09, 0.70, 0.75, nan],
        [0.53, 0.55, 0.44, 0.0, 9.0, np.inf],
    )
    # Of two readings the mean: (0.50 + 0.75) / 2.
    expected = np.array([[0.52, 0.55, 0.42, 0.70, 0.625, 0.0]], np.float32)
    np.testing.assert_array_equal(median_depth(frames), expected)


def test_laplacian_variance_by_hand() -> None:
    # One bright pixel of 10 in the middle of 5x5 zeros: the Laplacian is -40 there, 10 at its
    # four neighbours: mean 0, variance (1600 + 4 * 100) / 25.
    spot = np.zeros((5, 5, 3), np.uint8)
    spot[2, 2] = 10
    assert sharpness(spot) == pytest.approx(80.0)


def test_sharpest_color_first_of_equals() -> None:
    edge = GREY.copy()
    edge[:, 1:] = 200
    soft = GREY.copy()
    soft[:, 1:] = 120
    depths = [np.full((2, 3), 0.5, np.float32)] * 4
    fused = fuse_burst([GREY, soft, edge, edge], depths)
    assert fused.burst_frame == 2
    np.testing.assert_array_equal(fused.color, edge)


@pytest.mark.parametrize(
    ("colors", "depths"),
    [
        ([], []),
        ([GREY], []),
        ([GREY], [np.ones((3, 3), np.float32)]),
        ([GREY, GREY[:1]], [np.ones((2, 3), np.float32)] * 2),
    ],
)
def test_what_is_no_burst_is_refused(colors: list[Any], depths: list[Any]) -> None:
    with pytest.raises(CaptureError, match="burst"):
        fuse_burst(colors, depths)
