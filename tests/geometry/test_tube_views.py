"""One body of known shape from two cameras of known place, by the exact readings of both."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.geometry.tube import TubeShape, shape_from_curve
from cucumbervision.geometry.tube_evidence import Evidence
from cucumbervision.geometry.tube_fit import fit_shape
from cucumbervision.geometry.tube_guess import guess_shape
from cucumbervision.geometry.tube_views import SeenFrom, fit_views
from cucumbervision_lab.synthesis.bodies import rotation

RADIUS, LONG = 0.02, 0.16  # a straight body along x, its end centres LONG apart
PLACE = np.array([0.0, 0.0, 0.5])
# The second camera's coordinates: the body turned by 75 degrees and shifted by 6, 2 and 3 cm.
TURN, SHIFT = rotation(75, 20, 3), np.array([-0.06, 0.02, 0.03])
STILL, HERE = np.eye(3), np.zeros(3)


def centres() -> NDArray[np.float64]:
    x = np.linspace(-LONG / 2, LONG / 2, 40)
    return PLACE + np.stack([x, 0 * x, 0 * x], axis=1)


def points_from(turn: NDArray[np.float64], shift_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """The body's surface before a camera, in its coordinates."""
    axis = centres() @ turn.T + shift_m
    along = turn[:, 0]
    angle = np.linspace(-1.1, 1.1, 15)
    points = []
    for centre in axis:
        towards = -centre + (centre @ along) * along
        towards /= np.linalg.norm(towards)
        aside = np.cross(along, towards)
        points.append(centre + RADIUS * np.outer(np.cos(angle), towards))
        points[-1] += RADIUS * np.outer(np.sin(angle), aside)
    return np.concatenate(points)


def rays_from(turn: NDArray[np.float64], shift_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rays that just touch the balls at the body's ends and its sides between them."""
    axis = centres() @ turn.T + shift_m
    along = turn[:, 0]
    rays = []
    for k, centre in enumerate(axis):
        far = np.linalg.norm(centre)
        towards, sine = centre / far, RADIUS / far
        outward = -along if k == 0 else along
        outward = outward - (outward @ towards) * towards
        outward /= np.linalg.norm(outward)
        aside = np.cross(outward, towards)
        is_end = k in (0, len(axis) - 1)
        for angle in np.linspace(-np.pi / 2, np.pi / 2, 15 if is_end else 2):
            across = np.cos(angle) * outward + np.sin(angle) * aside
            rays.append(np.sqrt(1 - sine**2) * towards + sine * across)
    return np.array(rays)


def seen(
    turn: NDArray[np.float64], shift_m: NDArray[np.float64], first: int = 0, last: int = 40
) -> Evidence:
    """Return a camera's evidence of the body between two of its 40 centres."""
    points, rays = points_from(turn, shift_m), rays_from(turn, shift_m)
    ray_count = 2 * 38 + 2 * 15
    starts = np.r_[0, 15 + 2 * np.arange(39), ray_count]
    points = points[15 * first : 15 * last]
    rays = rays[starts[first] : starts[last]]
    return Evidence(points, np.full(len(points), 1e-3), rays, 7e-4, 1e-3, 0.5, 0.5)


def guess() -> TubeShape:
    inner = np.linspace(-0.3 * LONG, 0.3 * LONG, 9)
    curve = PLACE + np.stack([inner, 0 * inner, 0 * inner + 0.004], axis=1)
    return shape_from_curve(curve, 0.9 * RADIUS)


def length_m(shape: TubeShape) -> float:
    ends, radii = shape.balls(2)
    return float(np.linalg.norm(ends[1] - ends[0]) + radii.sum())


def test_two_cameras_see_the_body_that_is_there() -> None:
    views = [SeenFrom(seen(STILL, HERE), STILL, HERE), SeenFrom(seen(TURN, SHIFT), TURN, SHIFT)]
    fitted = fit_views(views, guess())
    ends, radii = fitted.body.shape.balls(2)
    assert length_m(fitted.body.shape) == pytest.approx(LONG + 2 * RADIUS, abs=5e-4)
    np.testing.assert_allclose(np.abs(ends - PLACE), [[LONG / 2, 0, 0]] * 2, atol=7e-4)
    np.testing.assert_allclose(radii, RADIUS, atol=5e-4)
    assert fitted.body.ends_seen == (True, True)
    np.testing.assert_array_equal(fitted.poses[0], np.eye(4))
    np.testing.assert_allclose(fitted.poses[1][:3, :3], TURN, atol=2e-3)
    np.testing.assert_allclose(fitted.poses[1][:3, 3], SHIFT, atol=1e-3)


def test_a_pose_that_is_known_badly_is_put_right() -> None:
    told_turn = rotation(0, 0, 2) @ TURN
    told_shift = SHIFT + np.array([0.0, 0.015, -0.01])
    off = SeenFrom(seen(TURN, SHIFT), told_turn, told_shift)
    fitted = fit_views([SeenFrom(seen(STILL, HERE), STILL, HERE), off], guess())
    body_m = PLACE @ TURN.T + SHIFT
    pose = fitted.poses[1]
    # Where the second camera sees the body's middle, whatever turn about the body went with it.
    assert pose[:3, :3] @ PLACE + pose[:3, 3] == pytest.approx(body_m, abs=2e-3)
    assert length_m(fitted.body.shape) == pytest.approx(LONG + 2 * RADIUS, abs=1e-3)


def test_a_pose_that_is_known_well_is_believed() -> None:
    told = SHIFT + np.array([0.0, 0.01, 0.0])
    here, turned = seen(STILL, HERE), seen(TURN, SHIFT)
    held = SeenFrom(turned, TURN, told, shift_sd_m=1e-6, turn_sd_rad=1e-6)
    fitted = fit_views([SeenFrom(here, STILL, HERE), held], guess())
    assert fitted.poses[1][:3, 3] == pytest.approx(told, abs=1e-4)


def test_one_view_is_the_fit_of_one_view() -> None:
    evidence = seen(STILL, HERE)
    alone = fit_shape(evidence, guess_shape(evidence.points_m))
    fitted = fit_views([SeenFrom(evidence, STILL, HERE)], guess())
    assert len(fitted.poses) == 1
    assert length_m(fitted.body.shape) == pytest.approx(length_m(alone.shape), abs=5e-4)
    assert fitted.body.ends_seen == alone.ends_seen == (True, True)


def test_ends_of_two_views_make_one_whole_body() -> None:
    left, right = seen(STILL, HERE, 0, 28), seen(TURN, SHIFT, 12, 40)
    views = [SeenFrom(left, STILL, HERE), SeenFrom(right, TURN, SHIFT, 1e-3, 1e-3)]
    both = fit_views(views, guess()).body
    assert both.ends_seen == (True, True)
    assert length_m(both.shape) == pytest.approx(LONG + 2 * RADIUS, rel=0.015)
    alone = fit_views(views[:1], guess()).body
    assert sorted(alone.ends_seen) == [False, True]
    assert alone.centreline_sd_m > 2 * both.centreline_sd_m
