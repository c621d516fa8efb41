from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.tube.test_fit import FAR, RADIUS, body, surface, tangent_rays

from cucumbervision.arrays import Array
from cucumbervision.tube.evidence import (
    depth_across,
    depth_gaps,
    end_overhangs,
    ends_seen,
    gaps,
    outline_cracks,
    quick_median,
    valid_median,
)
from cucumbervision.tube.shape import shape_from_curve

CURVE_X = np.linspace(0.0, 0.16, 33)
BODY = shape_from_curve(np.stack([CURVE_X, 0 * CURVE_X, 0 * CURVE_X + 0.5], axis=1), 0.02)


def rays_to(points_m: Array) -> Array:
    return np.asarray(points_m / np.linalg.norm(points_m, axis=1, keepdims=True))


def outline(beyond_m: float) -> Array:
    """Rays through a side view's outline whose end is half an ellipse, pointed beyond x = 0.18."""
    angle = np.linspace(0, 1.57, 21)
    x, y = 0.16 + (0.02 + beyond_m) * np.sin(angle), 0.02 * np.cos(angle)
    upper = np.stack([x, y, 0 * x + 0.5], axis=1)
    return rays_to(np.vstack([upper, upper * [1, -1, 1]]))


@pytest.mark.parametrize("beyond_m", [0.004, 0.010])
def test_a_pointed_end_reaches_beyond_its_last_ball(beyond_m: float) -> None:
    rays = outline(beyond_m)
    found = gaps(BODY, rays, rays=True)
    assert ends_seen(BODY, found, rays) == (False, True)
    first, last = end_overhangs(BODY, found, rays)
    assert first == 0.0  # no outline goes round it
    assert 0.3 * beyond_m < last <= beyond_m


def test_a_round_end_has_no_overhang() -> None:
    angle = np.linspace(-1.5, 1.5, 41)
    x, y = 0.16 + 0.02 * np.cos(angle), 0.02 * np.sin(angle)
    # Rays that touch a ball before the camera pass a little outside its widest circle.
    rays = rays_to(np.stack([x, y, 0 * x + 0.5], axis=1))
    found = gaps(BODY, rays, rays=True)
    assert end_overhangs(BODY, found, rays) == pytest.approx((0.0, 0.0), abs=3e-4)


def test_an_overhang_is_at_most_a_radius() -> None:
    rays = outline(0.2)
    assert end_overhangs(BODY, gaps(BODY, rays, rays=True), rays)[1] <= 0.02 + 1e-9


def test_surface_points_and_tangent_rays_have_no_gap() -> None:
    assert np.abs(gaps(body(), surface(), rays=False).gap_m).max() < 1e-5
    assert np.abs(gaps(body(), tangent_rays(), rays=True).gap_m).max() < 1e-5


def test_depth_gaps_follow_the_ray() -> None:
    points = surface()
    far = np.linalg.norm(points, axis=1)
    rays = points / far[:, None]
    found, facing = depth_gaps(body(), rays, far)
    assert np.abs(found.gap_m).max() < 1e-5
    shifted, _ = depth_gaps(body(), rays, far - 0.002)
    np.testing.assert_allclose(shifted.gap_m[facing > 0.3], 0.002 * facing[facing > 0.3], atol=1e-5)


def test_a_ray_that_misses_the_body_has_its_points_own_gap() -> None:
    aside = np.array([[0.0, 3 * RADIUS, FAR]])
    far = np.linalg.norm(aside, axis=1)
    found, facing = depth_gaps(body(), aside / far[:, None], far)
    assert facing[0] == 0.0
    np.testing.assert_allclose(found.gap_m, 2 * RADIUS, atol=1e-5)


def test_an_even_count_gives_the_mean_of_the_two_middle_values() -> None:
    values = np.array([[4.0], [1.0], [2.0], [100.0]])
    valid = np.array([[True], [True], [True], [False]])
    assert valid_median(values, valid).tolist() == [2.0]
    assert valid_median(values[:3], valid[:3] & (values[:3] != 2.0)).tolist() == [2.5]


@settings(deadline=None)
@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=1, max_size=12))
def test_the_quick_median_is_numpys(values: list[float]) -> None:
    exact = np.array(values)
    for array in (exact, exact.astype(np.float32)):
        assert quick_median(array) == np.median(array)


def test_no_valid_value_gives_nan() -> None:
    assert np.isnan(valid_median(np.ones((3, 2)), np.zeros((3, 2), bool))).all()


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(-1e6, 1e6), st.booleans()), min_size=1, max_size=12))
def test_equals_numpy_on_the_valid_values(pairs: list[tuple[float, bool]]) -> None:
    values = np.array([p[0] for p in pairs])
    valid = np.array([p[1] for p in pairs])
    result = valid_median(values, valid)
    if valid.any():
        assert np.isclose(result, np.median(values[valid]))
    else:
        assert np.isnan(result)


def test_keeps_the_dtype() -> None:
    assert valid_median(np.ones((2, 2), np.float32), np.ones((2, 2), bool)).dtype == np.float32


def test_the_outline_runs_between_pixels_and_is_unbiased() -> None:
    rows, columns = np.mgrid[0:101, 0:101]
    disc = np.hypot(columns - 50.3, rows - 49.8) <= 30.0
    points, outward = outline_cracks(disc)
    from_centre = points - (50.3, 49.8)
    radius = np.hypot(*from_centre.T)
    # A crack is at most half a pixel's diagonal off, and on the whole not off at all.
    assert np.abs(radius - 30).max() < 0.71
    assert radius.mean() == pytest.approx(30, abs=0.05)
    assert ((from_centre * outward).sum(axis=1) > 0).all()


def test_at_the_pictures_edge_there_is_no_outline() -> None:
    mask = np.zeros((20, 20), bool)
    mask[5:10, :8] = True
    points, _ = outline_cracks(mask)
    assert points[:, 0].min() == 0  # the sides' first pixels, and nothing before them
    assert len(points) == 5 + 2 * 8


def test_depth_is_looked_for_on_the_side_asked_for() -> None:
    depth = np.full((20, 20), 0.9, np.float32)
    depth[:, :10] = 0.5
    depth[3, 11:13] = 0.0
    at, right = np.array([[9.5, 3.0], [9.5, 8.0]]), np.array([[1.0, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(depth_across(depth, at, right), 0.9, rtol=1e-6)
    np.testing.assert_allclose(depth_across(depth, at, -right), 0.5, rtol=1e-6)


def test_without_readings_the_depth_across_is_unknown() -> None:
    nothing = depth_across(np.zeros((9, 9)), np.array([[4.5, 4.0]]), np.array([[1.0, 0.0]]))
    assert np.isnan(nothing).all()
    outside = depth_across(np.ones((9, 9)), np.array([[8.5, 4.0]]), np.array([[1.0, 0.0]]))
    assert np.isnan(outside).all()
