from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.scenarios.sensor_statistics import plane_residuals, residual_at

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.scene import Plane, Scene


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
