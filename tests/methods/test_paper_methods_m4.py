from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.methods.paper_methods import measure_m4
from cucumbervision.methods.result import LengthKind, Reason

RADIUS_PX, PIXEL_M = 400.0, 0.455 / 910  # at 0.455 m one pixel is 0.5 mm


@pytest.fixture
def flat() -> NDArray[np.float32]:
    return np.full((720, 1280), 0.455, np.float32)


@pytest.fixture
def arc() -> NDArray[np.float64]:
    """Five landmarks on a 60 degree arc of 400 px radius."""
    angle = np.deg2rad(np.linspace(-30, 30, 5))
    u, v = 640 + RADIUS_PX * np.sin(angle), 700 - RADIUS_PX * np.cos(angle)
    return np.stack([u, v, np.ones(5)], axis=1)


def test_five_landmarks_give_four_chords(
    flat: NDArray[np.float32], arc: NDArray[np.float64], camera: Intrinsics
) -> None:
    result = measure_m4(flat, None, arc, camera)
    by_hand = 8 * RADIUS_PX * np.sin(np.deg2rad(7.5)) * PIXEL_M
    assert result.length_m == pytest.approx(by_hand, rel=1e-6)
    assert result.kind is LengthKind.KEYPOINT_POLYLINE
    # Against the arc itself: four chords over 60 degrees lose 0.29 %, not the paper's 0.8 %.
    assert 1 - by_hand / (RADIUS_PX * np.pi / 3 * PIXEL_M) == pytest.approx(0.0029, abs=1e-4)


def test_four_landmarks_skip_the_unseen_one(
    flat: NDArray[np.float32], arc: NDArray[np.float64], camera: Intrinsics
) -> None:
    arc[2, 2] = 0.24
    by_hand = 2 * RADIUS_PX * (2 * np.sin(np.deg2rad(7.5)) + np.sin(np.deg2rad(15))) * PIXEL_M
    assert measure_m4(flat, None, arc, camera).length_m == pytest.approx(by_hand, rel=1e-6)


def test_three_landmarks_give_the_straight_line(
    flat: NDArray[np.float32], arc: NDArray[np.float64], camera: Intrinsics
) -> None:
    arc[1:3, 2] = 0.0
    by_hand = 2 * RADIUS_PX * np.sin(np.deg2rad(30)) * PIXEL_M
    assert measure_m4(flat, None, arc, camera).length_m == pytest.approx(by_hand, rel=1e-6)


@pytest.mark.parametrize("end", [0, 4])
def test_an_endpoint_needs_half_visibility(
    flat: NDArray[np.float32], arc: NDArray[np.float64], camera: Intrinsics, end: int
) -> None:
    arc[end, 2] = 0.49
    assert measure_m4(flat, None, arc, camera).reason is Reason.ENDPOINT_MISSING
    arc[end, 2] = 0.50
    assert measure_m4(flat, None, arc, camera).is_direct


def test_a_landmark_on_the_background_is_left_out(
    flat: NDArray[np.float32], arc: NDArray[np.float64], camera: Intrinsics
) -> None:
    u, v = np.rint(arc[1, :2]).astype(int)
    flat[v - 3 : v + 4, u - 3 : u + 4] = 0.55  # 9.5 cm behind the others
    arc[3, 2] = 0.0
    result = measure_m4(flat, None, arc, camera)
    assert result.length_m == pytest.approx(RADIUS_PX * PIXEL_M, rel=1e-6)  # the 60 degree chord


def test_only_readings_inside_the_mask_count(
    flat: NDArray[np.float32], arc: NDArray[np.float64], camera: Intrinsics
) -> None:
    u, v = np.rint(arc[0, :2]).astype(int)
    flat[v - 2 : v + 3, u - 2 : u] = 1.0  # the window's left part sees past the fruit
    flat[v - 2 : v + 3, u] = 1.0
    mask = np.zeros(flat.shape, bool)
    mask[flat < 0.5] = True
    assert measure_m4(flat, mask, arc, camera).is_direct
    assert measure_m4(flat, None, arc, camera).reason is Reason.ENDPOINT_MISSING


def test_without_depth_or_landmarks_it_says_so(
    arc: NDArray[np.float64], camera: Intrinsics
) -> None:
    empty = np.zeros((720, 1280), np.float32)
    assert measure_m4(empty, None, arc, camera).reason is Reason.ENDPOINT_MISSING
    assert measure_m4(empty, None, None, camera).reason is Reason.NO_KEYPOINTS


def test_landmarks_outside_the_picture_have_no_depth(
    flat: NDArray[np.float32], arc: NDArray[np.float64], camera: Intrinsics
) -> None:
    arc[0, :2] = (-40.0, 900.0)
    assert measure_m4(flat, None, arc, camera).reason is Reason.ENDPOINT_MISSING
