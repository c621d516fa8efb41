"""The noise of a stereo depth camera, laid over exact depth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["noisy_depth"]

BASELINE_M = 0.050
DISPARITY_RMS_PX = 0.08
FIXED_SHARE = 0.7  # of the variance: most of a D4xx's error stays in place from frame to frame
DEPTH_FOCAL_RATIO = 640 / 924  # of a D435's depth camera to its colour camera, both at 1280 wide
CORRELATION_PX = 2.0


def noisy_depth(
    depth_m: NDArray[np.float64],
    focal_px: float,
    frames: int,
    rng: np.random.Generator,
    unit_m: float = 0.001,
) -> list[NDArray[np.float32]]:
    """Return a burst of depth pictures as a D435 would read an exact scene.

    Disparity noise of RMS z² s / (f B), s = 0.08 px, part of it fixed in space and part new in
    each frame, both smooth over a few pixels; no reading where neighbouring depths jump; whole
    units.

    Parameters
    ----------
    depth_m : ndarray of float64, shape (H, W)
        Exact depth in metres; 0 where nothing is.
    focal_px : float
        The colour camera's focal length, from which the depth camera's follows.
    frames : int
        Size of the burst.
    rng : numpy.random.Generator
        Random generator.
    unit_m : float
        Depth unit, metres.

    Returns
    -------
    list of ndarray of float32, shape (H, W)
        Metres, multiples of `unit_m`; 0 where there is no reading.

    Examples
    --------
    >>> burst = noisy_depth(np.full((40, 40), 0.5), 924.0, 3, np.random.default_rng(1))
    >>> len(burst), bool(abs(np.mean(burst) - 0.5) < 0.001)
    (3, True)
    """
    sigma = depth_m**2 * DISPARITY_RMS_PX / (focal_px * DEPTH_FOCAL_RATIO * BASELINE_M)
    fixed = _smooth_noise(depth_m.shape, rng) * np.sqrt(FIXED_SHARE)
    edge = _jumps(depth_m)
    burst = []
    for _ in range(frames):
        fresh = _smooth_noise(depth_m.shape, rng) * np.sqrt(1 - FIXED_SHARE)
        reading = np.rint((depth_m + sigma * (fixed + fresh)) / unit_m) * unit_m
        lost = edge & (rng.random(depth_m.shape) < 0.5)
        burst.append(np.where((depth_m > 0) & ~lost, reading, 0.0).astype(np.float32))
    return burst


def _smooth_noise(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float64]:
    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), CORRELATION_PX)
    return np.asarray(noise / noise.std())


def _jumps(depth_m: NDArray[np.float64], at_least_m: float = 0.02) -> NDArray[np.bool_]:
    kernel = np.ones((3, 3), np.uint8)
    picture = depth_m.astype(np.float32)
    spread = cv2.dilate(picture, kernel) - cv2.erode(picture, kernel)
    return np.asarray(spread > at_least_m)
