from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.geometry.camera import Distortion
from cucumbervision_lab.synthesis.bodies import rotation
from cucumbervision_lab.synthesis.raycast import (
    Leaf,
    Plane,
    Stem,
    cast_leaf,
    cast_plane,
    cast_stem,
    ray_grid,
)

CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)


BENT = Intrinsics(
    640, 480, 600.0, 600.0, 320.0, 240.0,
    distortion=Distortion.BROWN_CONRADY, coefficients=(0.1, -0.05, 1e-3, -1e-3, 0),
)  # fmt: skip


@pytest.mark.parametrize("camera", [CAMERA, BENT])
@pytest.mark.parametrize("bend", [(0.0, 0.0), (3.0, -2.0), (5.0, 5.0)])
def test_points_of_a_leaf_lie_on_its_blade(camera: Intrinsics, bend: tuple[float, float]) -> None:
    frame = rotation(20, 30, 40)
    leaf = Leaf(np.array([0.05, -0.03, 0.5]), frame, 0.08, 0.05, bend, 0.15)
    hit = cast_leaf(leaf, camera)
    assert hit is not None
    grid = ray_grid(camera)
    z = hit.depth_m[hit.mask]
    x, y = grid.x[hit.window][hit.mask] * z, grid.y[hit.window][hit.mask] * z
    s, t, n = leaf.frame @ (np.stack([x, y, z]) - leaf.centre_m[:, None])
    assert len(z) > 3000
    assert np.abs(n - (bend[0] * s**2 + bend[1] * t**2) / 2).max() < 1e-12
    angle = np.arctan2(t / 0.05, s / 0.08)
    assert (np.hypot(s / 0.08, t / 0.05) <= 1 + 0.15 * np.cos(5 * angle) + 1e-9).all()


def test_a_flat_leaf_has_its_ellipse_area() -> None:
    leaf = Leaf(np.array([0.0, 0.0, 0.5]), np.eye(3), 0.06, 0.04)
    hit = cast_leaf(leaf, CAMERA)
    assert hit is not None
    by_hand = np.pi * 0.06 * 0.04 * (600 / 0.5) ** 2
    assert hit.mask.sum() == pytest.approx(by_hand, rel=0.01)


def test_points_of_a_stem_lie_at_its_radius() -> None:
    stem = Stem(np.array([[-0.1, -0.1, 0.4], [0.02, 0.0, 0.5], [0.03, 0.15, 0.45]]), 0.006)
    hit = cast_stem(stem, CAMERA)
    assert hit is not None
    grid = ray_grid(CAMERA)
    z = hit.depth_m[hit.mask]
    points = np.stack(
        [grid.x[hit.window][hit.mask] * z, grid.y[hit.window][hit.mask] * z, z], axis=1
    )
    gaps = []
    for a, b in zip(stem.vertices_m[:-1], stem.vertices_m[1:], strict=True):
        share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)[:, None]
        gaps.append(np.linalg.norm(points - a - share * (b - a), axis=1))
    assert np.min(gaps, axis=0) == pytest.approx(np.full(len(points), 0.006), abs=1e-9)


def test_points_of_a_plane_lie_in_it() -> None:
    plane = Plane.facing(0.7, 25.0, -10.0)
    grid, z = ray_grid(BENT), cast_plane(plane, BENT).depth_m
    points = np.stack([grid.x * z, grid.y * z, z], axis=2)
    assert np.abs((points - plane.point_m) @ plane.normal).max() < 1e-12
    # 25 degrees up and away: the upper rows are farther.
    assert z[0, 320] > z[-1, 320]


def test_a_leaf_behind_the_camera_is_refused() -> None:
    with pytest.raises(ValueError, match="behind the camera"):
        cast_leaf(Leaf(np.array([0.0, 0.0, 0.02]), rotation(tilt_deg=90), 0.05, 0.05), CAMERA)
