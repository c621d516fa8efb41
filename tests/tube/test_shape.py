from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.arrays import Array
from cucumbervision.tube.shape import (
    arc_positions,
    axis_path,
    bases,
    bending_direction,
    depth_gate,
    inner_arc_height,
    natural_spline,
    points_along,
    principal_axis,
    profile,
    thread_length,
)
from cucumbervision_lab.scenes.bodies import arc_tube


def test_evenly_spaced_controls_make_a_straight_line() -> None:
    # Of a spline of four segments, whose ends lie one control point in.
    bend, width = bases(33)
    np.testing.assert_allclose(bend @ (np.arange(7) - 1.0), 4 * np.linspace(0, 1, 33), atol=1e-12)
    np.testing.assert_allclose(width.sum(axis=1), 1)
    assert min(bend.min(), width.min()) >= 0


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


def straight(long_m: float, radii: Array) -> Array:
    x = np.linspace(0, long_m, len(radii))
    return np.stack([x, 0 * x, 0 * x + 0.5], axis=1)


@pytest.mark.parametrize(("bend_radius_m", "neck"), [(np.inf, 0.0), (0.3, 0.0), (0.15, 0.4)])
def test_lengths_of_a_drawn_body(bend_radius_m: float, neck: float) -> None:
    tube = arc_tube(0.25, 0.02, bend_radius_m, neck=neck)
    axis = axis_path(tube.centres_m, tube.radii_m)
    assert arc_positions(axis)[-1] == pytest.approx(0.25, abs=1e-6)
    outward = bending_direction(axis)
    if np.isfinite(bend_radius_m):
        # The neck's pole tilts the chord a little, and with it what is outward.
        assert outward @ tube.outward > 0.99
    thread = thread_length(tube.centres_m, tube.radii_m, outward)
    assert thread == pytest.approx(tube.thread_m, rel=1e-3)


def test_a_swallowed_ball_reaches_no_further_than_its_swallower() -> None:
    radii = np.full(50, 0.02)
    radii[-1] = 0.001
    radii[-2] = 0.0
    centres = straight(0.1, radii)
    step = 0.1 / 49
    axis = axis_path(centres, radii)
    assert axis[-1, 0] == pytest.approx(0.1 - 2 * step + 0.02)


def test_the_outer_side_of_a_straight_body_is_its_centreline_whatever_its_girth() -> None:
    radii = np.linspace(0.03, 0.01, 400)
    thread = thread_length(straight(0.2, radii), radii, np.array([0.0, 1.0, 0.0]))
    assert thread == pytest.approx(0.2 + 0.03 + 0.01, rel=1e-9)


def test_the_outer_side_of_a_quarter_turn_by_hand() -> None:
    # (R + r) pi / 2 on the outer side, and a radius straight on at each end.
    t = np.linspace(0, np.pi / 2, 2001)
    centres = 0.15 * np.stack([np.sin(t), np.cos(t), 0 * t], axis=1)
    outward = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    by_hand = (0.15 + 0.02) * np.pi / 2 + 2 * 0.02
    assert thread_length(centres, np.full(2001, 0.02), outward) == pytest.approx(by_hand, rel=1e-4)
    # Which side is called outward does not matter, nor does the direction of travel.
    again = thread_length(centres[::-1], np.full(2001, 0.02), -outward)
    assert again == pytest.approx(by_hand, rel=1e-4)


def test_where_the_radius_changes_it_weighs_the_turning_there() -> None:
    # The first half turns by 0.6 rad at 3 cm, the second by 0.4 rad at 1 cm: 0.018 + 0.004 m.
    heading = np.concatenate([np.linspace(0, 0.6, 2000), np.linspace(0.6, 1.0, 2000)])
    steps = 5e-5 * np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1)
    centres = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    radii = np.where(np.arange(4001) < 2000, 0.03, 0.01)
    outward = bending_direction(centres)
    by_hand = 0.2 + 0.03 + 0.01 + 0.6 * 0.03 + 0.4 * 0.01
    assert thread_length(centres, radii, outward) == pytest.approx(by_hand, rel=1e-4)


def test_the_inner_arc_of_a_bend() -> None:
    tube = arc_tube(0.30, 0.015, 0.15)
    angle = (0.30 - 0.03) / 0.15 / 2
    # The inner edge's top above the poles, which lie a radius beyond the last centres' tangents.
    top, pole = 0.15 - 0.015, 0.15 * np.cos(angle) - 0.015 * np.sin(angle)
    height = inner_arc_height(tube.centres_m, tube.radii_m, tube.poles_m, tube.outward)
    assert height == pytest.approx(top - pole, abs=2e-5)
    lying = arc_tube(0.20, 0.02, 0.60)
    assert inner_arc_height(lying.centres_m, lying.radii_m, lying.poles_m, lying.outward) == 0.0


def test_volume_of_a_bent_capsule_is_the_straight_ones() -> None:
    tube = arc_tube(0.25, 0.02, 0.2)
    by_hand = np.pi * 0.02**2 * 0.21 + 4 / 3 * np.pi * 0.02**3
    along, diameter = profile(tube.centres_m, tube.radii_m, 401)
    assert np.trapezoid(np.pi / 4 * diameter**2, along) == pytest.approx(by_hand, rel=1e-3)
    assert diameter[0] == pytest.approx(0, abs=1e-6)
    assert diameter.max() == pytest.approx(0.04, rel=1e-6)


def test_a_straight_body_has_some_outward_side() -> None:
    outward = bending_direction(straight(0.2, np.full(9, 0.02)))
    assert np.linalg.norm(outward) == pytest.approx(1)
    assert outward[0] == pytest.approx(0, abs=1e-9)


def test_a_ball_that_swallows_both_ends_leaves_the_axis_whole() -> None:
    centres = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.02, 0, 0]])
    axis = axis_path(centres, np.array([0.01, 0.1, 0.01]))
    assert axis[:, 0] == pytest.approx([-0.01, 0.0, 0.01, 0.02, 0.03])
