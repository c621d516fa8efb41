from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.arrays import Array
from cucumbervision.tube.evidence import Evidence
from cucumbervision.tube.fit import fit_shape, guess_shape, near_depths, stepped
from cucumbervision.tube.shape import TubeShape, shape_from_curve

FAR, RADIUS, LONG = 0.5, 0.02, 0.16  # a body across the view, its end centres LONG apart


def body() -> TubeShape:
    x = np.linspace(-LONG / 2, LONG / 2, 33)
    return shape_from_curve(np.stack([x, 0 * x, 0 * x + FAR], axis=1), RADIUS)


def surface(count: int = 40) -> Array:
    grid = np.meshgrid(np.linspace(-LONG / 2, LONG / 2, count), np.linspace(-0.9, 0.9, 15))
    x, across = (m.ravel() for m in grid)
    z = FAR - RADIUS * np.sqrt(1 - across**2)
    return np.stack([x, RADIUS * across, z], axis=1)


def tangent_rays(count: int = 60) -> Array:
    """Rays that just touch the body: beside its sides, and round its ends' balls."""
    rays = []
    sine = RADIUS / FAR
    for x in np.linspace(-LONG / 2, LONG / 2, count):
        for sign in (-1, 1):
            # In the plane through the camera and the axis' point; the axis is perpendicular.
            rays.append([x, sign * FAR * sine / np.sqrt(1 - sine**2), FAR])
    for x in (-LONG / 2, LONG / 2):
        centre = np.array([x, 0, FAR])
        along = centre / np.linalg.norm(centre)
        sine_end = RADIUS / np.linalg.norm(centre)
        side = np.cross([0, 1, 0], along)
        side /= np.linalg.norm(side)
        for turn in np.linspace(-np.pi / 2, np.pi / 2, count // 3):
            across = np.cos(turn) * side * np.sign(x) + np.sin(turn) * np.array([0, 1, 0])
            across -= (across @ along) * along
            across /= np.linalg.norm(across)
            rays.append(np.sqrt(1 - sine_end**2) * along + sine_end * across)
    stacked = np.array(rays)
    return np.asarray(stacked / np.linalg.norm(stacked, axis=1)[:, None])


def evidence(points: Array, rays: Array) -> Evidence:
    return Evidence(points, np.full(len(points), 1e-3), rays, 7e-4, 1e-3, 0.5, 0.5)


def test_the_body_is_found_again() -> None:
    fitting = fit_shape(evidence(surface(), tangent_rays()), guess_shape(surface()))
    centres, radii = fitting.shape.balls(9)
    ends = centres[[0, -1]][np.argsort(centres[[0, -1], 0])]
    np.testing.assert_allclose(ends, [[-LONG / 2, 0, FAR], [LONG / 2, 0, FAR]], atol=5e-4)
    np.testing.assert_allclose(radii, RADIUS, atol=5e-4)
    assert fitting.ends_seen == (True, True)
    assert 0 < fitting.centreline_sd_m < 0.002


def test_a_step_beyond_the_bodys_width_is_shortened() -> None:
    shape = body()
    limit = 0.6 * RADIUS + 0.002
    move = np.zeros(shape.bend_m.size + shape.width_m.size)
    move[0] = 10 * limit
    after, taken = stepped(shape, move)
    assert taken[0] == pytest.approx(limit)
    assert after.bend_m[0, 0] - shape.bend_m[0, 0] == pytest.approx(limit)
    move[0] = 0.9 * limit
    assert stepped(shape, move)[1][0] == pytest.approx(0.9 * limit)


def test_flying_pixels_and_stray_outline_have_little_say() -> None:
    rng = np.random.default_rng(3)
    points, rays = surface(), tangent_rays()
    flying = points[rng.choice(len(points), 60)] * rng.uniform(1.1, 2.0, (60, 1))
    stray = points[rng.choice(len(points), 12)] * (1, 0.3, 1)
    stray /= np.linalg.norm(stray, axis=1)[:, None]
    seen = evidence(np.vstack([points, flying]), np.vstack([rays, stray]))
    fitting = fit_shape(seen, guess_shape(seen.points_m, near_depths(seen.points_m)))
    along = np.ptp(fitting.shape.balls(9)[0][:, 0])
    assert along + 2 * RADIUS == pytest.approx(LONG + 2 * RADIUS, rel=0.01)


def test_an_outline_beside_the_depth_picture_does_not_move_the_body() -> None:
    # All rays turned down by two pixels of 1 mrad: the registration of colour and depth is off.
    rays = tangent_rays() + np.array([0, 2e-3, 0])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    fitting = fit_shape(evidence(surface(), rays), guess_shape(surface()))
    centres, _ = fitting.shape.balls(9)
    assert np.ptp(centres[:, 0]) == pytest.approx(LONG, rel=0.01)
    # The rays alone would have it 2 mrad of 0.5 m lower.
    assert np.abs(centres[:, 1]).max() < 0.25e-3


def test_an_end_without_outline_is_said_not_to_be_seen() -> None:
    rays = tangent_rays()
    rays = rays[rays[:, 0] < 0.06]
    points = surface()
    points = points[points[:, 0] < 0.04]
    fitting = fit_shape(evidence(points, rays), guess_shape(points))
    first_is_left = fitting.shape.balls(2)[0][0, 0] < 0
    assert fitting.ends_seen == ((True, False) if first_is_left else (False, True))


def test_more_noise_makes_a_wider_interval() -> None:
    rng = np.random.default_rng(5)
    rough = tangent_rays() + rng.normal(0, 3e-3, (len(tangent_rays()), 3))
    rough /= np.linalg.norm(rough, axis=1)[:, None]
    exact = fit_shape(evidence(surface(), tangent_rays()), guess_shape(surface()))
    noisy = fit_shape(evidence(surface(), rough), guess_shape(surface()))
    assert noisy.centreline_sd_m > 1.5 * exact.centreline_sd_m
