from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.tube.shape import (
    arc_positions,
    depth_gate,
    natural_spline,
    points_along,
    principal_axis,
)


def test_a_helix_has_its_analytic_length() -> None:
    t = np.linspace(0, 2 * np.pi, 60)
    helix = np.stack([0.03 * np.cos(t), 0.03 * np.sin(t), 0.2 * t / (2 * np.pi)], axis=1)
    by_hand = np.hypot(2 * np.pi * 0.03, 0.2)
    assert natural_spline(helix)[0] == pytest.approx(by_hand, rel=2e-4)


def test_a_repeated_vertex_changes_nothing() -> None:
    vertices = np.array([[0.0, 0, 0], [1.0, 1, 0], [2.0, 0, 0]])
    twice = vertices[[0, 1, 1, 2, 2]]
    assert natural_spline(twice)[0] == natural_spline(vertices)[0]


def test_a_spline_through_three_points_by_hand() -> None:
    # With y = 0, 1, 0 at x = 0, 1, 2 the second derivative is 0 at both ends and -3 in the middle:
    # y = (3 x - x^3) / 2 up to there, 11/16 halfway.
    _, path = natural_spline(np.array([[0.0, 0, 5], [1.0, 1, 5], [2.0, 0, 5]]), 5)
    assert path[:, 1] == pytest.approx([0, 11 / 16, 1, 11 / 16, 0])
    assert path[:, 2] == pytest.approx(5)


def test_points_along_a_bent_line() -> None:
    corner = np.array([[0, 0], [3, 0], [3, 1]])
    assert arc_positions(corner).tolist() == [0, 3, 4]
    assert points_along(corner, (0.0, 0.5, 0.75, 0.875, 1.0)).tolist() == [
        [0, 0],
        [2, 0],
        [3, 0],
        [3, 0.5],
        [3, 1],
    ]


def test_principal_axis_is_the_first_right_singular_vector() -> None:
    rng = np.random.default_rng(4)
    cloud = rng.normal(0, (0.1, 0.02, 0.01), (500, 3)) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    centroid, axis = principal_axis(cloud)
    first = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=False)[2][0]
    assert abs(float(axis @ first)) == pytest.approx(1.0, abs=1e-12)
    assert centroid == pytest.approx(cloud.mean(axis=0))


def test_the_gate_keeps_its_own_border() -> None:
    z = np.array([0.25, 0.5, 0.75])
    points = np.stack([z, z, z], axis=1)
    assert depth_gate(points, 0.25)[:, 2].tolist() == [0.25, 0.5, 0.75]
    assert depth_gate(points, 0.2499)[:, 2].tolist() == [0.5]
