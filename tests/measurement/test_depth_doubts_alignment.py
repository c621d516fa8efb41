"""Outlines that lie beside their fruit in depth, on capsules of known place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.capsules import CAMERA, Capsule, capsule_capture, lying, with_depth

from cucumbervision.capture.frames import Capture
from cucumbervision.measurement.depth_doubts import depth_doubts
from cucumbervision.measurement.flags import Flag


def is_elsewhere(capture: Capture) -> bool:
    doubts = depth_doubts(capture.depth_m, capture.masks[0], capture.intrinsics.fx_px)
    return Flag.DEPTH_UNALIGNED in doubts


@pytest.mark.parametrize("moved_px", [(0, 16), (0, -24), (14, 14)])
def test_depth_that_lies_beside_its_outline_is_unaligned(moved_px: tuple[int, int]) -> None:
    capture = capsule_capture(lying(0.16, distance_m=0.5))
    shifted = with_depth(capture, np.roll(capture.depth_m, moved_px, axis=(1, 0)))
    assert is_elsewhere(shifted)
    slightly = with_depth(capture, np.roll(capture.depth_m, (2, 2), axis=(1, 0)))
    assert not is_elsewhere(slightly)


@pytest.mark.parametrize("rise_m", [0.0, 0.08, 0.16])
def test_moved_depth_is_told_where_the_camera_looks_at_a_bench_at_an_angle(rise_m: float) -> None:
    # A fruit of 0.1 m between its ends' centres, and the bench it lies on: z = 0.518 + slope * x.
    lying_on = Capsule((-0.05, 0.0, 0.5 - rise_m / 2), (0.05, 0.0, 0.5 + rise_m / 2), 0.018)
    capture = capsule_capture(lying_on)
    x = (np.arange(CAMERA.width) - CAMERA.cx_px) / CAMERA.fx_px
    bench_m = np.broadcast_to(0.518 / (1 - rise_m / 0.1 * x), capture.depth_m.shape)
    capture = with_depth(
        capture, np.where(capture.masks[0], np.minimum(capture.depth_m, bench_m), bench_m)
    )
    assert not is_elsewhere(capture)
    for moved_px in (18, -18):
        moved = with_depth(capture, np.roll(capture.depth_m, moved_px, axis=0))
        assert is_elsewhere(moved)


def test_depth_of_a_wider_camera_of_the_same_size_is_unaligned() -> None:
    # As a D435 writes depth that nobody aligned: 0.69 of colour's focal length.
    wider = replace(CAMERA, fx_px=0.69 * 462, fy_px=0.69 * 462)
    for across_m, down_m in ((0.03, 0.05), (0.03, 0.06), (0.0, 0.0)):
        fruit = lying(0.16, across_m=across_m, down_m=down_m)
        capture = capsule_capture(fruit)
        unaligned = with_depth(capture, capsule_capture(fruit, camera=wider).depth_m)
        assert not is_elsewhere(capture)
        assert is_elsewhere(unaligned)
