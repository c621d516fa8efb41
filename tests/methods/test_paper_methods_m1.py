from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.paper_methods import measure_m1, window_depths
from cucumbervision.methods.result import LengthKind, Reason
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.scene import Scene, render

LENGTH_M, RADIUS_M, DEPTH_M = 0.20, 0.018, 0.5


def read_tilted(camera: Intrinsics, roll_deg: float, backdrop_m: float) -> float:
    tube = arc_tube(LENGTH_M, RADIUS_M).moved(rotation(roll_deg=roll_deg), (0, 0, DEPTH_M))
    scene = render(Scene.of(tube, backdrop_m=backdrop_m), camera)
    result = measure_m1(scene.depth_m.astype(np.float32), box_of_mask(scene.mask(0)), camera)
    assert result.length_m is not None
    return result.length_m


@pytest.mark.parametrize("roll_deg", [0.0, 15.0, 30.0, 45.0])
def test_before_a_backdrop_at_its_own_depth_it_reads_near_the_cosine(
    camera: Intrinsics, roll_deg: float
) -> None:
    theta = np.deg2rad(roll_deg)
    read = read_tilted(camera, roll_deg, backdrop_m=DEPTH_M)
    # The box is as long as the outline: L cos t plus what the thickness adds, at most 2 r sin t;
    # 1 % for the ends' own depth, which is not the backdrop's.
    allowed = 2 * RADIUS_M * np.sin(theta) + 0.01 * LENGTH_M
    assert read == pytest.approx(LENGTH_M * np.cos(theta), abs=allowed)


@pytest.mark.parametrize("backdrop_m", [0.0, 1.2])
def test_before_empty_or_far_space_the_lines_leave_a_tilted_fruit(
    camera: Intrinsics, backdrop_m: float
) -> None:
    assert read_tilted(camera, 30.0, backdrop_m) < 0.75 * LENGTH_M * np.cos(np.deg2rad(30))


def test_an_upright_plate_is_measured_along_its_longer_side(camera: Intrinsics) -> None:
    depth = np.full((720, 1280), 0.455, np.float32)  # 1 px = 0.5 mm
    box = np.array([600.0, 100.0, 640.0, 500.0])
    result = measure_m1(depth, box, camera)
    assert result.length_m == pytest.approx(0.200, abs=1e-6)
    assert result.kind is LengthKind.BOX_CHORD
    assert result.path_m is not None
    assert np.ptp(result.path_m[:, 0]) == pytest.approx(0, abs=1e-9)


def test_the_median_of_three_lines_is_taken(camera: Intrinsics) -> None:
    depth = np.zeros((720, 1280), np.float32)
    # Three plates of different length under the three lines of a box 400 x 80 px at 20, 40, 60.
    for row, length_px in ((320, 400), (340, 300), (360, 200)):
        depth[row - 5 : row + 6, 400 : 400 + length_px + 1] = 0.455
    box = np.array([400.0, 300.0, 800.0, 380.0])
    result = measure_m1(depth, box, camera)
    # Samples stand every 400/12 px; the last on the 300 px plate that still meets it (window of
    # 11) is the tenth, at 300 px: 150 mm.
    assert result.length_m == pytest.approx(0.150, abs=1e-6)


def test_without_a_reading_in_the_middle_there_is_no_length(camera: Intrinsics) -> None:
    depth = np.full((720, 1280), 0.5, np.float32)
    depth[300:400, 500:700] = 0
    result = measure_m1(depth, np.array([400.0, 300.0, 800.0, 399.0]), camera)
    assert result.length_m is None
    assert result.reason is Reason.NO_DEPTH


def test_samples_off_the_reference_depth_do_not_count(camera: Intrinsics) -> None:
    depth = np.full((720, 1280), 0.9, np.float32)
    depth[:, 460:821] = 0
    depth[330:370, 590:690] = 0.5  # the only readings of the middle ninth
    box = np.array([100.0, 320.0, 1180.0, 380.0])
    result = measure_m1(depth, box, camera)
    # Samples every 90 px from 100 on: 640 meets the plate, 550 and 730 do not.
    assert result.reason is Reason.TOO_FEW_SAMPLES


def test_a_window_is_cut_at_the_picture_and_skips_holes() -> None:
    depth = np.zeros((5, 5), np.float32)
    depth[0, :3] = 0.4, 0.6, 0.8
    corner = window_depths(depth, np.array([0.0]), np.array([0.0]), 5)
    assert corner == pytest.approx([0.6])
    mask = np.zeros((5, 5), bool)
    mask[0, 2] = True
    inside = window_depths(depth, np.array([0.0]), np.array([0.0]), 5, mask)
    assert inside == pytest.approx([0.8])
    far = window_depths(depth, np.array([4.0]), np.array([4.0]), 3)
    assert np.isnan(far).all()
