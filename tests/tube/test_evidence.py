from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.tube.test_fit import FAR, RADIUS, body, surface, tangent_rays

from cucumbervision.tube.evidence import depth_gaps, end_overhangs, ends_seen, gaps
from cucumbervision.tube.shape import shape_from_curve

CURVE_X = np.linspace(0.0, 0.16, 33)
BODY = shape_from_curve(np.stack([CURVE_X, 0 * CURVE_X, 0 * CURVE_X + 0.5], axis=1), 0.02)


def rays_to(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(points_m / np.linalg.norm(points_m, axis=1, keepdims=True))


def outline(beyond_m: float) -> NDArray[np.float64]:
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
