from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.intrinsics import Distortion, Intrinsics
from cucumbervision_lab.scenes.bodies import Tube, arc_tube, random_fruit, rotation
from cucumbervision_lab.scenes.placing import occlude, trellis
from cucumbervision_lab.scenes.scene import (
    Kind,
    Leaf,
    Plane,
    Scene,
    Stem,
    cast_leaf,
    cast_stem,
    cast_tube,
    ray_grid,
    render,
    truth_of,
)

CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)


def test_moving_the_scene_is_moving_the_camera() -> None:
    rng = np.random.default_rng(4)
    scene = trellis(rng, CAMERA, (random_fruit(rng, 0.2).moved(rotation(-90), (0.0, 0.0, 0.5)),))
    turn, by = rotation(2, -1, 3), np.array([0.01, -0.02, 0.03])
    back = scene.moved(turn, by).moved(turn.T, -turn.T @ by)
    first, again = render(scene, CAMERA), render(back, CAMERA)
    same = first.kind == again.kind
    assert same.mean() > 0.9999
    assert np.abs(first.depth_m - again.depth_m)[same & (first.body == again.body)].max() < 1e-6


def test_masks_and_hidden_share() -> None:
    tube = arc_tube(0.2, 0.02).moved(np.eye(3), (0, 0, 0.5))
    rod = Stem(np.array([[0.04, -0.3, 0.4], [0.04, 0.3, 0.4]]), 0.01)
    scene = Scene((tube,), stems=(rod,), planes=(Plane.facing(0.9),))
    view = render(scene, CAMERA)
    (truth,) = truth_of(scene, CAMERA, view)
    alone = render(Scene((tube,)), CAMERA).mask(0)
    assert (truth.amodal == alone).all()
    assert (truth.visible == (alone & (view.kind != Kind.STEM))).all()
    # The rod at 0.4 m spans 2 * 0.01 / 0.4 * 600 = 30 px of the fruit's 0.2 / 0.5 * 600 = 240.
    assert truth.hidden_share == pytest.approx(30 / 240, abs=0.015)
    assert not truth.cut_off
    # KP0 to KP4 stand at x = -0.1, -0.05 ... at 0.5 m; the rod is seen at 365 to 395 px.
    assert truth.keypoints_px[:, 0] == pytest.approx([200, 260, 320, 380, 440], abs=1e-6)
    assert truth.keypoint_visibility.tolist() == [2, 2, 2, 1, 2]
    assert truth.axis_m.shape == (len(truth.radius_m), 3)
    assert truth.radius_m[[0, -1]].tolist() == [0.0, 0.0]


def test_an_end_behind_the_fruits_own_body_is_hidden() -> None:
    # Tilted by 70 degrees, the near end covers most of the rest: the far pole is out of sight.
    tube = arc_tube(0.12, 0.02).moved(rotation(0, 75), (0.0, 0.0, 0.5))
    (truth,) = truth_of(Scene((tube,)), CAMERA)
    assert tube.poles_m[1, 2] > tube.poles_m[0, 2]
    assert truth.keypoint_visibility[4] == 1
    assert truth.keypoint_visibility[0] == 2


@pytest.mark.parametrize("share", [0.2, 0.4, 0.55])
@pytest.mark.parametrize("tilt_deg", [0.0, 45.0])
def test_cover_hides_the_share_asked_and_leaves_the_ends(share: float, tilt_deg: float) -> None:
    rng = np.random.default_rng(12)
    for length_m in (0.15, 0.30):
        fruit = random_fruit(rng, length_m).moved(rotation(-90, tilt_deg), (0.0, 0.0, 0.55))
        scene = occlude(Scene((fruit,)), CAMERA, 0, share, rng)
        (truth,) = truth_of(scene, CAMERA)
        assert truth.hidden_share == pytest.approx(share, abs=0.03)
        whole = truth.amodal
        ends = (whole & ~truth.visible)[np.flatnonzero(whole.any(axis=1))[[2, -3]]]
        assert not ends.any()


def test_a_cover_never_reaches_behind_the_camera() -> None:
    unchanged = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        fruit = random_fruit(rng, 0.4).moved(rotation(-90, 75.0), (0.0, 0.0, 0.3))
        bare = Scene((fruit,))
        covered = occlude(bare, CAMERA, 0, 0.6, rng, ends_free=False)
        truth_of(covered, CAMERA)  # raises if anything is behind it
        unchanged += covered is bare
    assert unchanged > 0


def test_every_seen_point_lies_on_the_surface() -> None:
    tube = arc_tube(0.2, 0.02, 0.25).moved(rotation(30, 25, 70), (0.03, -0.02, 0.5))
    scene = render(Scene.of(tube), CAMERA)
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
    scene = render(Scene.of(ball), CAMERA)
    # A ball straight ahead is seen within tan(asin(r / z)).
    radius_px = 600 * np.tan(np.arcsin(0.03 / 0.5))
    assert scene.mask(0).sum() == pytest.approx(np.pi * radius_px**2, rel=0.01)
    assert scene.depth_m[240, 320] == pytest.approx(0.47)
    assert scene.normal[240, 320] == pytest.approx([0, 0, -1])


def test_lens_distortion_moves_the_outline() -> None:
    bent = Intrinsics(
        640, 480, 600.0, 600.0, 320.0, 240.0,
        distortion=Distortion.BROWN_CONRADY, coefficients=(0.2, 0, 0, 0, 0),
    )  # fmt: skip
    tube = arc_tube(0.2, 0.02).moved(rotation(), (0.12, 0, 0.5))
    plain, seen = render(Scene.of(tube), CAMERA).mask(0), render(Scene.of(tube), bent).mask(0)
    # Barrel or pincushion: with k1 > 0 a point at x/z is seen at x/z (1 + k1 (x/z)^2).
    right = np.flatnonzero(plain.any(axis=0))[-1]
    moved = np.flatnonzero(seen.any(axis=0))[-1]
    slope = (right - 320) / 600
    assert moved - right == pytest.approx(600 * 0.2 * slope**3, abs=1.5)


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
