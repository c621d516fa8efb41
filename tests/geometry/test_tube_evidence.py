from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.geometry.tube import shape_from_curve
from cucumbervision.geometry.tube_evidence import end_overhangs, ends_seen
from cucumbervision.geometry.tube_gaps import gaps

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
