"""Figures that tell a depth camera's frames from a model's: measured alike on both.

All lengths in the picture are pixels of the picture given.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

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
