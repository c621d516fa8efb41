from __future__ import annotations

import numpy as np
import pytest

from cucumbervision_lab.synthesis.tube import arc_tube, helix_tube, rotation


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


def test_helix_by_hand() -> None:
    tube = helix_tube(0.008, 0.02, 0.15, 1.5)
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
