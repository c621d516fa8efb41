from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.geometry.curve import natural_spline, polyline_length


def test_a_straight_line_has_its_own_length() -> None:
    vertices = np.outer(np.array([0.0, 0.1, 0.25, 1.0]), [0.3, 0.0, 0.4])
    length, path = natural_spline(vertices)
    assert length == pytest.approx(0.5, abs=1e-12)
    assert path[0] == pytest.approx(vertices[0])
    assert path[-1] == pytest.approx(vertices[-1])


def test_a_helix_has_its_analytic_length() -> None:
    t = np.linspace(0, 2 * np.pi, 60)
    helix = np.stack([0.03 * np.cos(t), 0.03 * np.sin(t), 0.2 * t / (2 * np.pi)], axis=1)
    by_hand = np.hypot(2 * np.pi * 0.03, 0.2)
    assert natural_spline(helix)[0] == pytest.approx(by_hand, rel=2e-4)


def test_a_repeated_vertex_changes_nothing() -> None:
    vertices = np.array([[0.0, 0, 0], [1.0, 1, 0], [2.0, 0, 0]])
    twice = vertices[[0, 1, 1, 2, 2]]
    assert natural_spline(twice)[0] == natural_spline(vertices)[0]


def test_vertices_a_rounding_apart_are_one() -> None:
    vertices = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1 + 1e-17, 1e-17, 0], [0.2, 0, 0]])
    assert natural_spline(vertices)[0] == pytest.approx(0.2)


def test_one_place_is_no_curve() -> None:
    with pytest.raises(ValueError, match="two distinct vertices"):
        natural_spline(np.ones((4, 3)))


def test_polyline_of_one_vertex_has_no_length() -> None:
    assert polyline_length(np.zeros((1, 3))) == 0.0
