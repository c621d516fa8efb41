from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Distortion, Intrinsics
from cucumbervision_lab.synthesis.bodies import Tube, arc_tube, rotation
from cucumbervision_lab.synthesis.render import render

CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)


def test_every_seen_point_lies_on_the_surface() -> None:
    tube = arc_tube(0.2, 0.02, 0.25).moved(rotation(30, 25, 70), (0.03, -0.02, 0.5))
    scene = render([tube], CAMERA)
    v, u = np.nonzero(scene.mask(0))
    x, y = CAMERA.rays(u, v)
    points = np.stack([x, y, np.ones_like(x)], axis=1) * scene.depth_m[v, u][:, None]
    # Distance to the axis as a polyline of 800 balls: the ripple is far below a micrometre.
    gap = np.min(
        np.linalg.norm(points[::37, None] - tube.centres_m[None], axis=2) - tube.radii_m, axis=1
    )
    assert np.abs(gap).max() < 1e-6


def test_a_ball_has_its_analytic_outline() -> None:
    ball = Tube(
        np.array([[0.0, 0, 0.5], [0.0, 0, 0.5001]]), np.full(2, 0.03), np.array([0.0, -1, 0])
    )
    scene = render([ball], CAMERA)
    # A ball straight ahead is seen within tan(asin(r / z)).
    radius_px = 600 * np.tan(np.arcsin(0.03 / 0.5))
    assert scene.mask(0).sum() == pytest.approx(np.pi * radius_px**2, rel=0.01)
    assert scene.depth_m[240, 320] == pytest.approx(0.47)
    assert scene.normal[240, 320] == pytest.approx([0, 0, -1])


def test_the_nearer_fruit_hides_the_other() -> None:
    back = arc_tube(0.2, 0.02).moved(rotation(0), (0, 0, 0.6))
    front = arc_tube(0.2, 0.02).moved(rotation(90), (0, 0, 0.5))
    scene = render([back, front], CAMERA)
    assert scene.fruit[240, 320] == 1
    alone = render([back], CAMERA).mask(0)
    assert (scene.mask(0) == (alone & ~scene.mask(1))).all()


def test_a_backdrop_in_front_hides_everything() -> None:
    tube = arc_tube(0.2, 0.02).moved(rotation(), (0, 0, 0.5))
    scene = render([tube], CAMERA, backdrop_m=0.4)
    assert not scene.mask(0).any()
    assert (scene.depth_m == 0.4).all()


def test_shares_run_from_blossom_to_stem_end() -> None:
    tube = arc_tube(0.2, 0.02).moved(rotation(), (0, 0, 0.5))
    scene = render([tube], CAMERA)
    row = scene.share[240][scene.mask(0)[240]]
    assert row[0] == 0.0
    assert row[-1] == 1.0
    assert (np.diff(row) >= 0).all()


def test_lens_distortion_moves_the_outline() -> None:
    bent = Intrinsics(
        640, 480, 600.0, 600.0, 320.0, 240.0,
        distortion=Distortion.BROWN_CONRADY, coefficients=(0.2, 0, 0, 0, 0),
    )  # fmt: skip
    tube = arc_tube(0.2, 0.02).moved(rotation(), (0.12, 0, 0.5))
    plain, seen = render([tube], CAMERA).mask(0), render([tube], bent).mask(0)
    # Barrel or pincushion: with k1 > 0 a point at x/z is seen at x/z (1 + k1 (x/z)^2).
    right = np.flatnonzero(plain.any(axis=0))[-1]
    moved = np.flatnonzero(seen.any(axis=0))[-1]
    slope = (right - 320) / 600
    assert moved - right == pytest.approx(600 * 0.2 * slope**3, abs=1.5)


def test_behind_the_camera_is_refused() -> None:
    tube = arc_tube(0.2, 0.02).moved(rotation(tilt_deg=90), (0, 0, 0.05))
    with pytest.raises(ValueError, match="behind the camera"):
        render([tube], CAMERA)
