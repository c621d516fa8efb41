from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.frames import valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision_lab.scenes import depth_camera
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.scene import Leaf, Plane, Scene, render

COLOR = Intrinsics(640, 360, 462.0, 462.0, 320.0, 180.0)
CAMERA = D4xx.like(COLOR)
CALM = replace(
    CAMERA, disparity_rms_px=0.0, unit_m=1e-5, subpixel_step_px=1e-4, registration_px=(0.0, 0.0)
)
WALL = Scene((), planes=(Plane.facing(0.6),))


def burst_of(scene: Scene, camera: D4xx, frames: int = 1, seed: int = 5) -> list[np.ndarray]:
    return list(sense(scene, camera, np.random.default_rng(seed), frames))


def test_a_calm_camera_reads_the_exact_depth_of_a_slanted_wall() -> None:
    wall = Scene((), planes=(Plane.facing(0.6, tilt_deg=15.0, turn_deg=-20.0),))
    reading = burst_of(wall, CALM)[0]
    exact = render(wall, COLOR).depth_m
    read = reading > 0
    assert read.mean() > 0.99
    # A colour pixel takes a depth pixel's reading from up to 0.8 colour pixels away.
    slope = max(np.abs(np.diff(exact, axis=0)).max(), np.abs(np.diff(exact, axis=1)).max())
    assert np.abs(reading - exact)[read].max() < 2.5 * slope


@pytest.mark.parametrize("distance_m", [0.4, 0.8])
def test_noise_is_disparity_noise(distance_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_camera, "_CORRELATION_PX", 1.5)
    camera = replace(CAMERA, unit_m=1e-5)
    reading = burst_of(Scene((), planes=(Plane.facing(distance_m),)), camera)[0]
    # sd(z) = z² s / (f B), the depth camera's f being 320 px at 640 wide.
    by_hand = distance_m**2 * camera.disparity_rms_px / (320.0 * 0.05)
    assert reading[reading > 0].std() == pytest.approx(by_hand, rel=0.1)


@pytest.mark.parametrize("fixed", [0.2, 0.7])
def test_the_fixed_share_is_what_frames_have_in_common(
    fixed: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(depth_camera, "_CORRELATION_PX", 2.0)
    camera = replace(CAMERA, unit_m=1e-5, fixed_share=fixed)
    assert noise_split(burst_of(WALL, camera, frames=5)) == pytest.approx(fixed, abs=0.04)


def test_the_same_seed_gives_the_same_frames_and_another_does_not() -> None:
    first, again = burst_of(WALL, CAMERA, 2), burst_of(WALL, CAMERA, 2)
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    assert (first[0] != first[1]).any()
    assert (burst_of(WALL, CAMERA, 1, seed=6)[0] != first[0]).any()


def test_readings_are_whole_millimetres_beyond_the_nearest_distance() -> None:
    near = Scene((), planes=(Plane.facing(0.30, turn_deg=30.0),))
    reading = burst_of(near, CAMERA)[0]
    assert np.abs(reading * 1000 - np.rint(reading * 1000)).max() < 1e-3
    assert reading[reading > 0].min() >= CAMERA.min_z_m
    assert (reading == 0).mean() > 0.2


def test_the_shadow_stands_to_the_left_and_is_as_wide_as_both_parallaxes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("_HIDDEN_FILLED", "_SPECKLE"):
        monkeypatch.setattr(depth_camera, name, 0.0)
    board = Leaf(np.array([0.0, 0.0, 0.45]), np.eye(3), 0.06, 0.06)
    scene = Scene((), leaves=(board,), planes=(Plane.facing(0.9),))
    row = burst_of(scene, replace(CALM, foliage_holes=0.0))[0][180]
    centre = 320
    radius = round(0.06 / 0.45 * 462)
    left = np.count_nonzero(row[centre - radius - 60 : centre - radius] == 0)
    right = np.count_nonzero(row[centre + radius : centre + radius + 60] == 0)
    # By hand: (0.05 + 0.015) m seen at 462 px, at 0.45 m less at 0.9 m: 33 px; a few more or
    # less by the border's own gap.
    assert left == pytest.approx(0.065 * 462 * (1 / 0.45 - 1 / 0.9), abs=6)
    assert right < 8


def test_glare_takes_its_share_of_the_fruit() -> None:
    tube = arc_tube(0.2, 0.022).moved(rotation(-80), (0, 0, 0.45))
    scene = Scene((tube,), planes=(Plane.facing(0.5),))
    inner = render(scene, COLOR).mask(0)
    dry, wet = (
        (burst_of(scene, replace(CALM, glare_holes=share))[0][inner] > 0).mean()
        for share in (0.0, 0.2)
    )
    assert dry - wet == pytest.approx(0.2, abs=0.05)


WINDOW_PX = 26


def _windows(depth_m: NDArray[Any], window_px: int) -> NDArray[np.float64]:
    height, width = (n // window_px * window_px for n in depth_m.shape)
    blocks = depth_m[:height, :width].reshape(
        height // window_px, window_px, width // window_px, window_px
    )
    flat = blocks.transpose(0, 2, 1, 3).reshape(-1, window_px * window_px)
    return flat[valid_depth(flat).all(axis=1)].astype(np.float64)


def _left_over(windows: NDArray[np.float64]) -> NDArray[np.float64]:
    side = round(np.sqrt(windows.shape[1]))
    y, x = (g.ravel() - (side - 1) / 2 for g in np.mgrid[0:side, 0:side])
    base, _ = np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=1))
    return np.asarray((windows - (windows @ base) @ base.T).std(axis=1))


def plane_residuals(
    depth_m: NDArray[np.float32], window_px: int = WINDOW_PX
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a plane to each window of the picture and give what is left.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres; 0 where there is no reading.
    window_px : int
        Side of the windows, which lie side by side; only those without a hole count.

    Returns
    -------
    distance_m, rms_m : ndarray of float64, shape (K,)
        Mean depth and root mean square residual of each window, metres.

    Examples
    --------
    >>> depth = np.fromfunction(lambda v, u: 0.5 + 1e-4 * u + 2e-4 * v, (50, 75)).astype("f4")
    >>> distance, rms = plane_residuals(depth, window_px=25)
    >>> len(rms), bool(rms.max() < 1e-7)
    (6, True)
    """
    windows = _windows(depth_m, window_px)
    return windows.mean(axis=1), _left_over(windows)


def residual_at(
    residuals: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
    distance_m: float,
    within_m: float = 0.02,
) -> tuple[float, int]:
    """Return the median residual of the windows at a distance, and their number.

    Parameters
    ----------
    residuals : sequence of tuple
        What `plane_residuals` gave for each frame.
    distance_m, within_m : float
        Which windows count: `distance_m` ± `within_m`.

    Examples
    --------
    >>> residual_at([(np.array([0.49, 0.51, 0.9]), np.array([1e-3, 3e-3, 9e-3]))], 0.5)
    (0.002, 2)
    """
    distance, rms = (np.concatenate(part) for part in zip(*residuals, strict=True))
    chosen = rms[np.abs(distance - distance_m) < within_m]
    return (float(np.median(chosen)) if len(chosen) else float("nan")), len(chosen)


def noise_split(burst: Sequence[NDArray[np.float32]], window_px: int = WINDOW_PX) -> float:
    """Return the share of the noise's variance that stays from frame to frame.

    Of windows without a hole in any frame, on the residuals to their planes: the variance that
    two frames have in common over that of one frame. The camera and the scene must stand still.

    Parameters
    ----------
    burst : sequence of ndarray of float32, shape (H, W)
        At least two frames.
    window_px : int
        Side of the windows.
    """
    whole = np.all([valid_depth(frame) for frame in burst], axis=0)
    sums = _left_over(_windows(np.where(whole, np.mean(burst, axis=0), 0), window_px))
    single = [_left_over(_windows(np.where(whole, f, 0), window_px)) for f in burst]
    one, mean, n = float(np.mean(np.square(single))), float(np.mean(sums**2)), len(burst)
    # The mean of n frames keeps fixed + (1 - fixed) / n of the variance.
    return (mean / one - 1 / n) / (1 - 1 / n)


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
