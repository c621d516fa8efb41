from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.intrinsics import Distortion, Intrinsics
from cucumbervision_lab.scenes.bodies import Tube, rotation
from cucumbervision_lab.scenes.scene import Leaf, Stem, cast_leaf, cast_stem, cast_tube, ray_grid

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


def capsule(step_m: float) -> Tube:
    """A straight tube of 12 cm and 2 cm radius across the view, 40 cm away, in balls of a step."""
    x = np.arange(-0.06, 0.06 + step_m / 2, step_m)
    centres = np.stack([x, 0.01 + 0 * x, 0.4 + 0 * x], axis=1)
    return Tube(centres, np.full(len(x), 0.02), np.array([0.0, -1, 0]))


def depth_of_capsule() -> NDArray[np.float64]:
    """The first point of the cylinder (y - 1 cm)² + (z - 40 cm)² = (2 cm)², and of its ends."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    x, y = CAMERA.rays(u, v)
    best = np.full(x.shape, np.inf)
    # z² (y² + 1) - 2 z (0.01 y + 0.4) + 0.01² + 0.4² - 0.02² = 0
    a, b, c = y * y + 1, 0.01 * y + 0.4, 0.01**2 + 0.4**2 - 0.02**2
    with np.errstate(invalid="ignore"):
        z = (b - np.sqrt(b * b - a * c)) / a
        side = np.abs(z * x) <= 0.06
        best[side] = z[side]
        for end in (-0.06, 0.06):
            a = x * x + y * y + 1
            b = end * x + 0.01 * y + 0.4
            z = (b - np.sqrt(b * b - a * (c + end * end))) / a
            best = np.fmin(best, np.where(np.isnan(z), np.inf, z))
    return best


# With 200 balls and more, a coarse pass comes before the exact one.
@pytest.mark.parametrize("step_m", [0.0005, 0.0001])
def test_a_tube_of_many_balls_is_a_capsule(step_m: float) -> None:
    hit = cast_tube(capsule(step_m), CAMERA)
    assert hit is not None
    exact = depth_of_capsule()[hit.window]
    both = hit.mask & np.isfinite(exact)
    assert (hit.mask != np.isfinite(exact)).mean() < 0.005
    # Between two balls the surface lies lower by step² / (8 r), which a grazing ray sees as far
    # behind as a ball of radius r bends away by that: half a step.
    gap_m = np.abs(hit.depth_m[both] - exact[both])
    assert np.median(gap_m) < step_m**2 / (8 * 0.02)
    assert gap_m.max() < step_m / 2
    outside = depth_of_capsule()
    outside[hit.window] = np.inf
    assert not np.isfinite(outside).any()


def test_the_part_that_is_hit_tells_where_along_the_tube() -> None:
    tube = capsule(0.0001)
    hit = cast_tube(tube, CAMERA)
    assert hit is not None
    grid = ray_grid(CAMERA)
    x = (grid.x[hit.window] * hit.depth_m)[hit.mask]
    along = tube.centres_m[hit.part[hit.mask], 0]
    inside = np.abs(x) < 0.06
    assert np.abs(along[inside] - x[inside]).max() < 2e-4
    assert set(hit.part[~hit.mask].tolist()) == {0}
