from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision_lab.synthesis.bodies import (
    Tube,
    Variety,
    arc_tube,
    bent_tube,
    random_fruit,
    rotation,
)


@pytest.mark.parametrize("length_m", [0.069, 0.1472, 0.2570, 0.38])
def test_random_fruit_have_the_length_asked_and_a_believable_thickness(length_m: float) -> None:
    rng = np.random.default_rng(7)
    low, high = {0.069: (1.1, 1.7), 0.1472: (1.4, 2.2), 0.2570: (1.9, 2.7), 0.38: (1.9, 2.7)}[
        length_m
    ]
    for _ in range(20):
        fruit = random_fruit(rng, length_m)
        assert fruit.centreline_m == pytest.approx(length_m, abs=1e-9)
        assert low < 100 * fruit.radii_m.max() < high
        assert fruit.chord_m <= fruit.centreline_m
        # Over both ends the thread is longer than the axis, however the fruit bends.
        assert fruit.thread_m > fruit.centreline_m
        slope = np.abs(np.diff(fruit.radii_m)) / np.linalg.norm(np.diff(fruit.centres_m, axis=0))
        assert slope.max() < 1.0


def test_the_seed_decides() -> None:
    first, again, other = (random_fruit(np.random.default_rng(s), 0.3) for s in (1, 1, 2))
    assert (first.centres_m == again.centres_m).all()
    assert first.radii_m[400] != other.radii_m[400]


def test_constant_curvature_is_the_arc() -> None:
    mine = bent_tube(0.26, np.full(800, 0.018), np.full(800, -1 / 0.2))
    arc = arc_tube(0.26, 0.018, 0.2)
    assert mine.chord_m == pytest.approx(arc.chord_m, rel=1e-6)
    assert mine.thread_m == pytest.approx(arc.thread_m, rel=1e-5)
    assert (mine.outward == arc.outward).all()


def s_tube(r: float, bend: float, angle: float) -> Tube:
    """Two arcs of one size, bent to opposite sides."""
    run = 2 * bend * angle
    curvature = np.repeat([1 / bend, -1 / bend], 1000)
    return bent_tube(run + 2 * r, np.full(2000, r), curvature)


def test_the_thread_of_an_s_by_hand() -> None:
    r, bend, angle = 0.02, 0.2, 0.8
    # The first arc about O = (0, 0) from straight below: at p its centre is bend (sin p, -cos p);
    # the second turns about the mirror image of O in the arc's end.
    middle = bend * np.array([np.sin(angle), -np.cos(angle)])
    last = 2 * middle + np.array([0.0, bend])
    # The thread runs on the circle about O of radius bend + r, then straight along the tangent
    # that this circle has in common with the last ball, then over that ball to the pole. With the
    # ball on the same side of the tangent as O, its length is sqrt(D² - (bend + r - r)²).
    away = np.hypot(*last)
    straight = np.sqrt(away**2 - bend**2)
    # The tangent's point on the circle, as an angle from straight below.
    towards = np.arctan2(last[0], -last[1])
    leaves = towards - np.arccos(bend / away)
    # The pole lies along the tangent of the axis at its end, which is level again: a quarter
    # turn after the ball's lowest point.
    over_cap = np.pi / 2 - leaves
    by_hand = np.pi / 2 * r + (bend + r) * leaves + straight + over_cap * r
    tube = s_tube(r, bend, angle)
    # Which of the two equal bends counts as the larger is chance: both threads are alike.
    assert tube.thread_m == pytest.approx(by_hand, rel=2e-4)
    assert by_hand < np.pi * r + 2 * bend * angle + 2 * r  # a laid, not taut thread is longer


def test_a_thread_spans_a_waist() -> None:
    centres = np.stack([np.linspace(-0.08, 0.08, 801), np.zeros(801), np.zeros(801)], axis=1)
    waist = 0.02 - 0.004 * np.sin(np.pi * np.linspace(0, 1, 801)) ** 2
    tube = Tube(centres, waist, np.array([0.0, -1.0, 0.0]))
    assert tube.thread_m == pytest.approx(0.16 + np.pi * 0.02, rel=1e-5)


def test_no_point_of_a_thread_lies_inside_the_body() -> None:
    rng = np.random.default_rng(11)
    for s_shape in (False, True):
        fruit = random_fruit(rng, 0.33, s_shape=s_shape, bend_radius_m=0.2)
        path = fruit.thread_path_m
        dense = np.concatenate([path[:-1] + t * np.diff(path, axis=0) for t in (0, 0.3, 0.7)])
        gap = np.linalg.norm(dense[:, None] - fruit.centres_m[None], axis=2) - fruit.radii_m
        assert gap.min() > -2e-6


def test_the_larger_bend_faces_outward() -> None:
    share = np.linspace(0, 1, 800)
    for sign in (1, -1):
        curvature = sign * np.where(share < 0.7, 1 / 0.25, -1 / 0.5)
        tube = bent_tube(0.3, np.full(800, 0.02), curvature)
        middle = tube.centres_m[280]
        ends = (tube.centres_m[0] + tube.centres_m[560]) / 2
        assert (middle - ends) @ tube.outward > 0.005


def test_too_short_is_refused() -> None:
    with pytest.raises(ValueError, match="shorter than its round ends"):
        random_fruit(np.random.default_rng(1), 0.02, Variety.LONG)


@pytest.mark.parametrize("bend_radius_m", [0.15, 0.30, np.inf])
@pytest.mark.parametrize("length_m", [0.07, 0.25, 0.38])
def test_the_centreline_is_what_was_asked(length_m: float, bend_radius_m: float) -> None:
    assert arc_tube(length_m, 0.02, bend_radius_m).centreline_m == pytest.approx(length_m, rel=1e-5)


def test_a_straight_tube_by_hand() -> None:
    tube = arc_tube(0.20, 0.02)
    assert tube.chord_m == pytest.approx(0.20)
    # Over two quarter circles and the straight side between them.
    assert tube.thread_m == pytest.approx(0.16 + np.pi * 0.02, rel=1e-4)


@pytest.mark.parametrize("bend_radius_m", [0.15, 0.40])
def test_a_bent_tube_by_hand(bend_radius_m: float) -> None:
    r, length = 0.018, 0.26
    tube = arc_tube(length, r, bend_radius_m)
    angle = (length - 2 * r) / bend_radius_m
    assert tube.thread_m == pytest.approx((bend_radius_m + r) * angle + np.pi * r, rel=2e-4)
    # The poles lie r further along the tangents, which stand at half the angle to the chord.
    chord = 2 * bend_radius_m * np.sin(angle / 2) + 2 * r * np.cos(angle / 2)
    assert tube.chord_m == pytest.approx(chord, rel=1e-4)


def test_a_neck_shortens_the_thread_over_the_stem_end() -> None:
    plain, necked = arc_tube(0.25, 0.02), arc_tube(0.25, 0.02, neck=0.4)
    assert necked.centreline_m == pytest.approx(plain.centreline_m, rel=1e-5)
    # The stem end's quarter circle shrinks by (pi/2 - 1) of the 8 mm that its radius lost.
    lost = (np.pi / 2 - 1) * 0.4 * 0.02
    assert plain.thread_m - necked.thread_m == pytest.approx(lost, rel=0.15)


def test_moving_changes_no_length() -> None:
    tube = arc_tube(0.25, 0.02, 0.3, neck=0.2)
    moved = tube.moved(rotation(30, 40, 50), (0.1, -0.2, 0.6))
    for name in ("centreline_m", "thread_m", "chord_m"):
        assert getattr(moved, name) == pytest.approx(getattr(tube, name), rel=1e-12)


def test_helix_by_hand(helix: Callable[[float, float, float], NDArray[np.float64]]) -> None:
    tube = Tube(helix(0.02, 0.15, 1.5), np.full(2000, 0.008), np.array([0.0, 1.0, 0.0]))
    by_hand = 1.5 * np.hypot(2 * np.pi * 0.02, 0.15) + 2 * 0.008
    assert tube.centreline_m == pytest.approx(by_hand, rel=1e-5)


def test_too_short_for_its_ends() -> None:
    with pytest.raises(ValueError, match="shorter than its round ends"):
        arc_tube(0.03, 0.02)


def test_rotation_is_proper() -> None:
    turn = rotation(20, -35, 130)
    assert turn @ turn.T == pytest.approx(np.eye(3))
    assert np.linalg.det(turn) == pytest.approx(1.0)
    axis = turn @ [1, 0, 0]
    assert np.rad2deg(np.arcsin(axis[2])) == pytest.approx(-35)
    assert np.rad2deg(np.arctan2(axis[1], axis[0])) == pytest.approx(20)
