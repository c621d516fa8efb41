"""Drawn grids, seen through a known lens by a depth camera of known scale."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.accuracy.calibration_file import calibrated_capture, write_site_calibration
from cucumbervision.accuracy.grid import fit_grid
from cucumbervision.accuracy.site_calibration import calibrate_camera
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Distortion, Intrinsics
from cucumbervision.errors import CalibrationError

LENS = (0.10, -0.16, 0.0, 0.0, 0.0)
CAMERA = Intrinsics(1280, 720, 912.0, 912.0, 638.0, 357.0)
TRUE_CAMERA = replace(CAMERA, distortion=Distortion.BROWN_CONRADY, coefficients=LENS)
SPACING_M, SCALE = 0.01, 0.977


def grid_capture(tilt_deg: float, *, dark: bool = False, name: str = "a") -> Capture:
    """Return a capture of a plane at 0.35 m with lines every centimetre, part of it covered."""
    tilt = np.deg2rad(tilt_deg)
    normal = np.array([0.0, np.sin(tilt), -np.cos(tilt)])
    along, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, np.cos(tilt), np.sin(tilt)])
    middle = np.array([0.0, 0.0, 0.35])
    u, v = np.meshgrid(np.arange(1280.0), np.arange(720.0))
    x, y = TRUE_CAMERA.rays(u, v)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    far = float(middle @ normal) / (rays @ normal)
    points = rays * far[..., None] - middle
    place = np.stack([points @ along, points @ down], axis=-1) / SPACING_M
    off_m = np.abs(place - np.rint(place)).min(axis=-1) * SPACING_M
    line = np.clip(1.5 - off_m / 0.0004, 0, 1) * (np.abs(place) < 11.2).all(axis=-1)
    gray = 60 + 110 * line if not dark else 220 - 150 * line
    depth = far.copy()
    fruit = np.hypot((u - 600) / 420, (v - 330 - 0.2 * (u - 600)) / 60) < 1
    gray[fruit], depth[fruit] = 100, depth[fruit] - 0.03
    color = np.repeat(np.rint(gray).astype(np.uint8)[..., None], 3, axis=2)
    depth_m = (np.rint(1000 * SCALE * depth) / 1000).astype(np.float32)
    blurred = np.asarray(cv2.GaussianBlur(color, (0, 0), 0.7), np.uint8)
    return Capture(blurred, depth_m, CAMERA, name=name)


@pytest.mark.parametrize("dark", [False, True])
def test_scale_and_lens_of_a_drawn_grid(dark: bool) -> None:
    fit = fit_grid([grid_capture(25.0, dark=dark), grid_capture(35.0, dark=dark)], SPACING_M)
    assert fit is not None
    assert fit.ratios == pytest.approx([SCALE, SCALE], abs=0.001)
    assert fit.residual_px < 0.3
    found = replace(TRUE_CAMERA, coefficients=tuple(fit.coefficients))
    u, v = np.meshgrid(np.arange(350.0, 950, 50), np.arange(100.0, 650, 50))
    (x, y), (true_x, true_y) = found.rays(u, v), TRUE_CAMERA.rays(u, v)
    off = np.hypot(x - true_x, y - true_y)
    assert np.median(off) * CAMERA.fx_px < 0.3


def test_a_picture_whose_lines_are_miscounted_is_left_out() -> None:
    taken = [grid_capture(tilt) for tilt in (25.0, 30.0, 35.0)]
    taken[1] = replace(taken[1], depth_m=taken[1].depth_m * np.float32(2**0.5))
    fit = fit_grid(taken, SPACING_M)
    assert fit is not None
    assert fit.ratios == pytest.approx([SCALE, SCALE], abs=0.001)


def test_a_calibrated_camera_measures_right(tmp_path: Path) -> None:
    site = calibrate_camera([grid_capture(30.0)], SPACING_M, "cam")
    write_site_calibration(tmp_path / "cam.json", site)
    other = grid_capture(20.0)
    done = calibrated_capture(other, site)
    # The plane, 0.35 m away in the middle, and a ray far from there.
    assert done.depth_m[60, 638] / other.depth_m[60, 638] == pytest.approx(1 / SCALE, abs=0.001)
    x, _ = done.intrinsics.rays(890.0, 357.0)
    true_x, _ = TRUE_CAMERA.rays(890.0, 357.0)
    bare_x, _ = CAMERA.rays(890.0, 357.0)
    assert abs(float(x - true_x)) < 0.25 * abs(float(bare_x - true_x))


def test_what_is_no_grid_is_refused() -> None:
    rng = np.random.default_rng(1)
    noise = replace(grid_capture(30.0), color=rng.integers(0, 255, (720, 1280, 3), np.uint8))
    with pytest.raises(CalibrationError, match="no grid of 40 crossings in 1 captures"):
        calibrate_camera([noise], SPACING_M, "x")
    with pytest.raises(CalibrationError, match="no grid"):
        calibrate_camera([], SPACING_M, "x")
    with pytest.raises(CalibrationError, match=r"depth reads 0.4.. times .* check the spacing"):
        calibrate_camera([grid_capture(30.0)], 0.02, "x")
    smaller = replace(CAMERA, fx_px=900.0)
    two = [grid_capture(30.0), replace(grid_capture(30.0, name="b"), intrinsics=smaller)]
    with pytest.raises(CalibrationError, match="capture 'b' is of another camera"):
        calibrate_camera(two, SPACING_M, "x")
