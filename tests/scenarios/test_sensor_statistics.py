from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.scenarios.sensor_statistics import (
    edge_profile,
    fill_inside,
    noise_split,
    plane_residuals,
    residual_at,
    surface_residual,
)

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.raycast import Plane
from cucumbervision_lab.synthesis.scene import Scene


def test_white_noise_on_a_slant_is_found_again() -> None:
    v, u = np.mgrid[0:250, 0:250]
    rng = np.random.default_rng(1)
    depth = (0.5 + 1e-4 * u - 5e-5 * v + rng.normal(0, 4e-4, v.shape)).astype(np.float32)
    distance, rms = plane_residuals(depth, 25)
    assert len(rms) == 100
    # A plane takes three of 625 degrees of freedom.
    assert np.median(rms) == pytest.approx(4e-4 * np.sqrt(622 / 625), rel=0.01)
    assert distance.min() == pytest.approx(0.5 + 1e-4 * 12 - 5e-5 * 237, abs=1e-4)


def test_windows_with_a_hole_do_not_count() -> None:
    depth = np.full((50, 50), 0.5, np.float32)
    depth[3, 3] = 0.0
    assert len(plane_residuals(depth, 25)[1]) == 3
    assert residual_at([plane_residuals(depth, 25)], 0.9)[1] == 0


def test_a_bowl_is_a_quadratic_but_no_plane() -> None:
    v, u = np.mgrid[0:100, 0:100]
    bowl = (0.5 + 1e-6 * ((u - 50.0) ** 2 + (v - 50.0) ** 2)).astype(np.float32)
    mask = np.zeros(bowl.shape, bool)
    mask[25:75, 25:75] = True
    assert surface_residual(bowl, mask, 25) < 1e-6
    assert plane_residuals(bowl)[1].min() > 5e-5
    assert np.isnan(surface_residual(bowl, np.zeros_like(mask)))


def test_fill_counts_readings() -> None:
    depth = np.array([[0.5, 0.0, 7.0], [0.4, 0.05, 0.6]], np.float32)
    assert fill_inside(depth, np.ones(depth.shape, bool)) == 0.5


@pytest.mark.parametrize("fixed", [0.0, 0.5, 1.0])
def test_noise_split_by_hand(fixed: float) -> None:
    rng = np.random.default_rng(2)
    still = rng.normal(0, 1e-3 * np.sqrt(fixed), (250, 250))
    burst = [
        (0.5 + still + rng.normal(0, 1e-3 * np.sqrt(1 - fixed), still.shape)).astype(np.float32)
        for _ in range(5)
    ]
    assert noise_split(burst) == pytest.approx(fixed, abs=0.01)


@pytest.mark.parametrize(("towards", "by"), [((0.0, -1.0), 3), ((1.0, 0.0), -2)])
def test_a_leak_is_found_on_its_side(towards: tuple[float, float], by: int) -> None:
    depth = np.full((100, 100), 0.6, np.float32)
    mask = np.zeros(depth.shape, bool)
    mask[30:80, 20:70] = True
    # The body's depth ends 3 px above the mask, and 2 px inside its right edge.
    depth[27:80, 20:68] = 0.5
    profile = edge_profile(depth, np.full(depth.shape, 0.6), mask, towards)
    assert profile.crossing_px(0.5) == pytest.approx(by, abs=0.3)
    assert profile.invalid.max() == 0.0


@pytest.mark.realdata
def test_the_model_errs_as_real_frames_do(shared_data: Path) -> None:
    folder = shared_data / "rgbd" / "carrot_realsense_1280"
    if not folder.is_dir():
        pytest.skip("the real RealSense frames are not there")
    real = [plane_residuals(ref.load().depth_m) for ref in open_source(folder)]
    color = Intrinsics(1280, 720, 927.17, 927.37, 651.32, 349.62)
    for distance_m in (0.38, 0.47, 0.56):
        measured, windows = residual_at(real, distance_m)
        wall = Scene((), planes=(Plane.facing(distance_m, 5.0, 5.0),))
        reading = sense(wall, D4xx.like(color), np.random.default_rng(1000), frames=1)[0]
        model, _ = residual_at([plane_residuals(reading)], distance_m)
        assert windows > 300
        assert model == pytest.approx(measured, rel=0.25)
