"""Model of D4xx depth noise: short ripples, and waves that shift a whole small fruit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_DISPARITY_RMS_PX = 0.08  # within windows of 26 pixels

_WAVES_RMS_PX = 0.17  # correlated over longer distances; 0.19 pixels in total

_WAVE_SIGMA_PX = 5.0  # sigma of their smoothing, in pixels of the depth camera

_MOST_WAVES = 48

_SKIN_RMS_M = 0.0005  # additional error of a glossy or dark skin at any distance

_EDGE_STEP_M, _EDGE_SIGMA_PX = (
    0.2,
    3.6,
)  # depth step to the background, and blur of the matching window

_KNOT_STEP = 1.4  # distance between knots, in sigmas

_DEPTH_FOCAL_RATIO = 0.69  # focal length of the depth camera relative to the colour camera, D435

_BASELINE_M = 0.050


def depth_noise(far_m: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
    """Return a D4xx's RMS depth error at a distance, metres: z² s / (f B).

    Parameters
    ----------
    far_m : ndarray of float64
        Distance along z.
    focal_px : float
        The colour camera's focal length, from which the depth camera's follows.

    Examples
    --------
    >>> bool(depth_noise(np.array(0.5), 924.0).round(5) == 0.00063)
    True
    """
    return far_m**2 * (_DISPARITY_RMS_PX / (focal_px * _DEPTH_FOCAL_RATIO * _BASELINE_M))


def edge_error(inside_px: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the possible depth error towards the background, metres, by distance from the outline.

    A matching window across a small disparity step gives a value in between.

    Parameters
    ----------
    inside_px : ndarray of float32
        Distance from the mask's outline, pixels.

    Examples
    --------
    >>> (1000 * edge_error(np.array([4.0, 8.0, 16.0], np.float32))).round(1).tolist()
    [26.7, 2.6, 0.0]
    """
    from scipy.special import ndtr

    return np.asarray(_EDGE_STEP_M * ndtr(-np.asarray(inside_px, np.float64) / _EDGE_SIGMA_PX))


def noise_waves(
    pixels: NDArray[np.intp], far_m: NDArray[np.float64], focal_px: float
) -> NDArray[np.float64]:
    """Return the effect of each wave of smooth depth noise on each point.

    Stereo matching errors are smooth over a dozen pixels, so that a small fruit is shifted and
    tilted as a whole. White noise at knots, blurred by a Gaussian, has the same covariance. On a
    large fruit, the knots are farther apart and the waves lower, so that the long waves, which
    tilt the fruit, keep their amplitude.

    Parameters
    ----------
    pixels : ndarray of int, shape (N, 2)
        Columns and rows of the points, colour pixels.
    far_m : ndarray of float64, shape (N,)
        Their distance along z, metres.
    focal_px : float
        The colour camera's focal length.

    Returns
    -------
    ndarray of float64, shape (N, W)
        Metres, for amplitudes of standard deviation 1; at most about `_MOST_WAVES` waves.

    Examples
    --------
    >>> v, u = (m.ravel() for m in np.indices((30, 60)))
    >>> waves = noise_waves(np.stack([u, v], axis=1), np.full(1800, 1.0), 924.0)
    >>> rms = np.sqrt((waves**2).sum(axis=1)).mean()
    >>> bool(abs(rms / depth_noise(np.array(1.0), 924.0) - _WAVES_RMS_PX / _DISPARITY_RMS_PX) < 0.2)
    True
    """
    if not len(pixels):
        return np.zeros((0, 0))
    first_px, last_px = pixels.min(axis=0), pixels.max(axis=0)
    step = _KNOT_STEP * _WAVE_SIGMA_PX / _DEPTH_FOCAL_RATIO
    width, tall = last_px - first_px + 2 * step
    wider = max(1.0, float(np.sqrt(width * tall / _MOST_WAVES)) / step)
    step *= wider
    sigma = step / _KNOT_STEP
    across, down = (
        np.exp(
            -0.5 * ((coordinates[:, None] - np.arange(a - step / 2, b + step, step)) / sigma) ** 2
        )
        for coordinates, a, b in zip(pixels.T, first_px, last_px, strict=True)
    )
    shape = (down[:, :, None] * across[:, None, :]).reshape(len(pixels), -1)
    shape = shape[:, shape.max(axis=0) > np.exp(-0.5 * (step / sigma) ** 2)]
    matching = _WAVES_RMS_PX / _DISPARITY_RMS_PX / wider * depth_noise(far_m, focal_px)
    strength = np.hypot(matching, _SKIN_RMS_M) * _KNOT_STEP / np.sqrt(np.pi)
    return np.asarray(shape * strength[:, None])
