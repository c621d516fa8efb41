from __future__ import annotations

import numpy as np
from tests.geometry.test_tube_fit import FAR, RADIUS, body, surface, tangent_rays

from cucumbervision.geometry.tube_gaps import depth_gaps, gaps


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
