from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.methods.result import LengthKind, MethodName, Reason
from cucumbervision.methods.table import AVAILABLE, Region, run_methods


@pytest.fixture
def region(camera: Intrinsics) -> Region:
    """A plate 200 x 20 mm at 0.455 m, where a pixel is half a millimetre."""
    depth = np.zeros((720, 1280), np.float32)
    depth[340:380, 440:840] = 0.455
    box = np.array([439.5, 339.5, 839.5, 379.5])
    return Region(depth, camera, box, depth > 0)


def test_all_methods_agree_on_a_plate(region: Region) -> None:
    results = run_methods(region)
    assert list(results) == list(AVAILABLE)
    for method in (MethodName.M1, MethodName.M2, MethodName.M3):
        assert results[method].length_m == pytest.approx(0.2, rel=0.02)
    # M5's tip anchors may stand in a corner, up to 10 mm beside the axis: its known zigzag.
    assert results[MethodName.M5].length_m == pytest.approx(0.2, rel=0.04)
    assert results[MethodName.M4].reason is Reason.NO_KEYPOINTS
    # A tube has round ends, and those that fit a plate's square ones best stand out a little.
    assert results[MethodName.M6].length_m == pytest.approx(0.2, rel=0.05)


def test_m3_falls_back_on_m2_below_50_pixels(region: Region, camera: Intrinsics) -> None:
    few = np.zeros_like(region.mask)
    few[340, 440:489] = True
    results = run_methods(Region(region.depth_m, camera, region.box, few))
    m3, m2 = results[MethodName.M3], results[MethodName.M2]
    assert m3.length_m == m2.length_m
    assert m3.method is MethodName.M3
    assert m3.measured_by is MethodName.M2
    assert m3.fallback == ("M3:too-few-points",)
    assert not m3.is_direct


def test_m4_falls_back_on_m3_and_on_to_m2(region: Region, camera: Intrinsics) -> None:
    unseen = np.zeros((5, 3))
    whole = run_methods(Region(region.depth_m, camera, region.box, region.mask, unseen))[
        MethodName.M4
    ]
    assert whole.measured_by is MethodName.M3
    assert whole.kind is LengthKind.SURFACE_CHORD
    assert whole.fallback == ("M4:endpoint-missing",)
    few = np.zeros_like(region.mask)
    few[340, 440:480] = True
    chain = run_methods(Region(region.depth_m, camera, region.box, few, unseen))[MethodName.M4]
    assert chain.measured_by is MethodName.M2
    assert chain.fallback == ("M4:endpoint-missing", "M3:too-few-points")


def test_where_nothing_can_stand_in_the_whole_path_is_told(camera: Intrinsics) -> None:
    depth = np.zeros((720, 1280), np.float32)
    mask = np.ones((720, 1280), bool)
    result = run_methods(Region(depth, camera, np.array([9.5, 9.5, 99.5, 99.5]), mask))[
        MethodName.M3
    ]
    assert result.length_m is None
    assert result.reason is Reason.TOO_FEW_POINTS
    assert result.fallback == ("M3:too-few-points", "M2:no-depth")


def test_without_a_mask_the_mask_methods_say_so(region: Region, camera: Intrinsics) -> None:
    results = run_methods(Region(region.depth_m, camera, region.box))
    assert results[MethodName.M3].reason is Reason.NO_MASK
    assert results[MethodName.M5].reason is Reason.NO_MASK
    assert results[MethodName.M6].reason is Reason.NO_MASK
    assert results[MethodName.M1].is_direct
    assert results[MethodName.M2].is_direct


def test_only_what_was_asked_runs(region: Region) -> None:
    assert list(run_methods(region, [MethodName.M5, MethodName.M1])) == [
        MethodName.M1,
        MethodName.M5,
    ]
