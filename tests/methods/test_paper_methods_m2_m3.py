from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.paper_methods import measure_m2, measure_m3
from cucumbervision.methods.result import Reason
from cucumbervision.methods.table import box_points, masked_points
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.scene import Scene, render


def visible_extent_m(length_m: float, radius_m: float, depth_m: float) -> float:
    """Chord between the outermost visible points of a straight tube lying across the view.

    The end ball stands at x = L/2 - r; a surface point with normal (sin a, 0, -cos a) is seen
    while z cos a - x sin a > r, so the last one has a = acos(r / hypot(x, z)) - atan(x / z).
    """
    x = length_m / 2 - radius_m
    last = np.arccos(radius_m / np.hypot(x, depth_m)) - np.arctan2(x, depth_m)
    return float(2 * (x + radius_m * np.sin(last)))


@pytest.mark.parametrize("roll_deg", [0.0, 37.0, 90.0])
@pytest.mark.parametrize("length_m", [0.08, 0.20])
def test_m3_reads_the_visible_extent_whatever_the_direction(
    camera: Intrinsics, length_m: float, roll_deg: float
) -> None:
    tube = arc_tube(length_m, 0.015).moved(rotation(roll_deg=roll_deg), (0, 0, 0.5))
    scene = render(Scene.of(tube), camera)
    result = measure_m3(masked_points(scene.depth_m.astype(np.float32), scene.mask(0), camera))
    expected = visible_extent_m(length_m, 0.015, 0.5)
    pixel_m = 0.5 / 910
    # At either end the outermost pixel's centre lies up to a pixel inside the outline, where the
    # surface is up to sqrt(2 r px) nearer and so, seen at the slope x/z, that much further in.
    lost = pixel_m + length_m / 2 / 0.5 * np.sqrt(2 * 0.015 * pixel_m)
    assert expected - 2 * lost <= (result.length_m or 0) <= expected


def test_m2_reads_the_same_where_the_box_holds_nothing_else(camera: Intrinsics) -> None:
    tube = arc_tube(0.20, 0.015).moved(rotation(), (0, 0, 0.5))
    scene = render(Scene.of(tube), camera)
    depth = scene.depth_m.astype(np.float32)
    m2 = measure_m2(box_points(depth, box_of_mask(scene.mask(0)), camera))
    # Stride 2 may miss the outermost column on either side.
    assert m2.length_m == pytest.approx(visible_extent_m(0.20, 0.015, 0.5), abs=2.5 * 0.5 / 910)


def test_m2_takes_in_a_backdrop_within_the_gate_and_m3_does_not(camera: Intrinsics) -> None:
    tube = arc_tube(0.20, 0.015).moved(rotation(roll_deg=45), (0, 0, 0.5))
    scene = render(Scene.of(tube, backdrop_m=0.51), camera)
    depth = scene.depth_m.astype(np.float32)
    m2 = measure_m2(box_points(depth, box_of_mask(scene.mask(0)), camera)).length_m
    m3 = measure_m3(masked_points(depth, scene.mask(0), camera)).length_m
    assert m2 is not None
    assert m3 is not None
    # The box's diagonal at the backdrop: (L - 2r) cos 45 + 2r a side, times sqrt 2.
    assert m2 == pytest.approx(np.sqrt(2) * ((0.20 - 0.03) * np.sqrt(0.5) + 0.03), rel=0.04)
    assert m3 < 0.202


def test_the_gate_cuts_a_fruit_tilted_towards_the_camera(camera: Intrinsics) -> None:
    tube = arc_tube(0.30, 0.015).moved(rotation(tilt_deg=60), (0, 0, 0.6))
    scene = render(Scene.of(tube), camera)
    result = measure_m3(masked_points(scene.depth_m.astype(np.float32), scene.mask(0), camera))
    assert result.length_m is not None
    # What is left is 7 cm deep: 0.07 / sin 60 along the axis, plus at most the tube's width.
    assert 0.07 / np.sin(np.deg2rad(60)) <= result.length_m <= 0.07 / np.sin(np.deg2rad(60)) + 0.03


def test_too_few_points_are_named() -> None:
    assert measure_m3(np.zeros((49, 3))).reason is Reason.TOO_FEW_POINTS
    assert measure_m2(np.empty((0, 3))).reason is Reason.NO_DEPTH
    far_apart = np.array([[0.0, 0, 0.3], [0.0, 0, 0.9]])
    assert measure_m2(far_apart).reason is Reason.TOO_FEW_POINTS


def test_path_ends_are_the_length_apart() -> None:
    rng = np.random.default_rng(0)
    cloud = rng.normal((0, 0, 0.5), (0.05, 0.01, 0.002), (400, 3))
    result = measure_m3(cloud)
    assert result.path_m is not None
    assert np.linalg.norm(result.path_m[1] - result.path_m[0]) == pytest.approx(result.length_m)


def test_a_mask_far_from_the_corner_keeps_its_place() -> None:
    camera = Intrinsics(640, 480, 500.0, 400.0, 320.0, 240.0)
    depth = np.full((480, 640), 0.5, np.float32)
    mask = np.zeros((480, 640), bool)
    mask[40, 570] = True
    points = masked_points(depth, mask, camera)
    assert points[0] == pytest.approx([0.5 * 250 / 500, 0.5 * -200 / 400, 0.5])
