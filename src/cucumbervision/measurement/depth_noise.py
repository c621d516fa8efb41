"""Model of D4xx depth noise: short ripples, and waves that shift a whole small fruit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_DISPARITY_RMS_PX = 0.08  # within windows of 26 pixels

_WAVES_RMS_PX = 0.17  # what goes on over longer ways: 0.19 pixels together

_WAVE_SIGMA_PX = 5.0  # of the Gaussian that makes them smooth, in the depth camera's pixels

_MOST_WAVES = 48

_SKIN_RMS_M = 0.0005  # and of a glossy or dark skin, however near it is

_EDGE_STEP_M, _EDGE_SIGMA_PX = 0.2, 3.6  # what lies behind, and the blur of the matching window

_KNOT_STEP = 1.4  # between knots, in sigmas

_DEPTH_FOCAL_RATIO = 0.69  # of a D435's depth camera to its colour camera

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
    """Return how far a reading may be drawn to what lies behind, metres, by its place in the mask.

    A matching window that reaches over a small step of disparity reads something between.

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
    """Return what each of some waves does to the depth of each point.

    A matcher's errors are smooth over a dozen pixels, so that a small fruit is moved and tilted
    as a whole. White noise at knots, blurred by a Gaussian, has the same covariance. On a large
    fruit the knots lie wider apart and the waves are lower, so that the long ones, which alone
    tilt it, keep their strength.

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
        Metres, for waves of standard deviation 1; about `_MOST_WAVES` at most.

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
