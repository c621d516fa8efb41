from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.geometry.outline import depth_across, outline_cracks


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
