from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.depth import depth_to_metres, require_readings
from cucumbervision.errors import DepthError

PLAUSIBLE = np.linspace(0.3, 2.0, 100).reshape(10, 10)


@pytest.mark.parametrize(
    ("raw", "unit_m", "expected_m"),
    [
        (np.array([[454]], np.uint16), None, 0.454),
        (np.array([[4540]], np.uint16), 0.0001, 0.454),
        (np.array([[454]], np.int32), None, 0.454),
        (np.array([[0.454]], np.float64), None, 0.454),
        (np.array([[454.0]], np.float32), 0.001, 0.454),
        (np.array([[[454]]], np.uint16), None, 0.454),
    ],
)
def test_units(raw: Any, unit_m: float | None, expected_m: float) -> None:
    depth_m = depth_to_metres(raw, unit_m)
    assert depth_m.dtype == np.float32
    assert depth_m.tolist() == [[np.float32(expected_m)]]


@pytest.mark.parametrize(
    ("raw", "unit_m", "words"),
    [
        (PLAUSIBLE, 0.001, "declared in millimetres.*100 % .*outside.*in metres 100 % lie inside"),
        ((PLAUSIBLE * 1000).astype(np.uint16), 1.0, "declared in metres.*in millimetres 100 %"),
        (PLAUSIBLE * 1000, None, "declared in metres.*in millimetres"),
        (PLAUSIBLE, 0.0001, r"steps of 0.1 mm.*in metres.*depth unit 1 m"),
        # 0.7 m in steps of 0.1 mm, which in steps of 0.2 mm is 1.4 m.
        (np.full((4, 4), 7000, np.uint16), None, r"in steps of 0.1 mm.*0.0001 m or 0.0002 m"),
        (np.full((4, 4), 28000, np.uint16), 0.001, r"in steps of 0.1 mm.*unit 0.0001 m$"),
    ],
)
def test_the_wrong_unit_is_named(raw: Any, unit_m: float | None, words: str) -> None:
    with pytest.raises(DepthError, match=words):
        depth_to_metres(raw, unit_m, source="a.png")


def test_shares_of_the_largest_distance_are_no_metres() -> None:
    shares = (PLAUSIBLE / PLAUSIBLE.max()).astype(np.float32)
    with pytest.raises(DepthError, match=r"a\.npy: .*no metres; .*declare the depth unit 1 m"):
        depth_to_metres(shares, source="a.npy")
    assert depth_to_metres(shares, 1.0).max() == 1.0
    clipped = np.minimum(np.rint(1000 * PLAUSIBLE) / 1000, 1.0).astype(np.float32)
    assert depth_to_metres(clipped).max() == 1.0


def test_holes_do_not_count_against_a_unit() -> None:
    raw = np.zeros((10, 10), np.uint16)
    raw[0, 0] = 450
    assert depth_to_metres(raw)[0, 0] == np.float32(0.45)


@pytest.mark.parametrize(
    "raw",
    [
        np.ones((4, 4), np.uint8),
        np.ones((4, 4), bool),
        np.ones((4, 4), complex),
        np.ones((4, 4, 3), np.uint16),
        np.ones(4, np.uint16),
        np.ones((0, 4), np.uint16),
    ],
)
def test_what_is_no_depth_is_refused(raw: Any) -> None:
    with pytest.raises(DepthError, match=r"a\.png.*give the 16-bit depth itself"):
        depth_to_metres(raw, source="a.png")


@pytest.mark.parametrize(
    ("value_m", "words"),
    [(0.0, "every pixel is 0"), (7.0, "readings run from 7 to 7 m"), (0.05, "from 0.05 to")],
)
def test_depth_without_readings_is_refused(value_m: float, words: str) -> None:
    with pytest.raises(DepthError, match=words):
        require_readings(np.full((4, 4), value_m, np.float32), source="a")
    depth = np.full((4, 4), value_m, np.float32)
    depth[1, 1] = 0.5
    require_readings(depth)


@pytest.mark.parametrize("unit_m", [1e-300, 1e300])
def test_a_step_that_no_camera_has_is_refused(unit_m: float) -> None:
    with pytest.raises(DepthError, match=re.escape(f"steps of {unit_m:g} m")):
        depth_to_metres(np.full((4, 4), 454, np.uint16), unit_m)
