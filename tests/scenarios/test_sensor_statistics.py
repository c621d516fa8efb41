from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.scenarios.sensor_statistics import noise_split, plane_residuals, residual_at

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.raycast import Plane
from cucumbervision_lab.scenes.scene import Scene


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


@pytest.mark.parametrize("fixed", [0.0, 0.5, 1.0])
def test_noise_split_by_hand(fixed: float) -> None:
    rng = np.random.default_rng(2)
    still = rng.normal(0, 1e-3 * np.sqrt(fixed), (250, 250))
    burst = [
        (0.5 + still + rng.normal(0, 1e-3 * np.sqrt(1 - fixed), still.shape)).astype(np.float32)
        for _ in range(5)
    ]
    assert noise_split(burst) == pytest.approx(fixed, abs=0.01)


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
