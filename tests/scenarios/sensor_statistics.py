"""Figures that tell a depth camera's frames from a model's: measured alike on both.

All lengths in the picture are pixels of the picture given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.instances.masks import distances_inside

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

WINDOW_PX = 26
_OFFSETS_PX = np.arange(-14, 21)


@dataclass(frozen=True, eq=False)
class EdgeProfile:
    """How a body's height over its ground falls across its outline.

    Parameters
    ----------
    offset_px : ndarray of int64, shape (K,)
        Distance from the outline, negative inside; `k` stands for k to k + 1.
    height : ndarray of float64, shape (K,)
        Median height over the ground there, as a share of the height well inside; NaN where too
        few pixels have a reading.
    invalid : ndarray of float64, shape (K,)
        Share of the pixels there without a reading.
    """

    offset_px: NDArray[np.int64]
    height: NDArray[np.float64]
    invalid: NDArray[np.float64]

    def crossing_px(self, share: float) -> float:
        """Return the offset where the height has fallen to a share, interpolated; or NaN."""
        for k in range(len(self.height) - 1):
            a, b = self.height[k], self.height[k + 1]
            if a >= share > b:
                return float(self.offset_px[k] + 0.5 + (a - share) / (a - b))
        return float("nan")


def _windows(depth_m: NDArray[Any], window_px: int) -> NDArray[np.float64]:
    height, width = (n // window_px * window_px for n in depth_m.shape)
    blocks = depth_m[:height, :width].reshape(
        height // window_px, window_px, width // window_px, window_px
    )
    flat = blocks.transpose(0, 2, 1, 3).reshape(-1, window_px * window_px)
    return flat[valid_depth(flat).all(axis=1)].astype(np.float64)


def _left_over(windows: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    side = round(np.sqrt(windows.shape[1]))
    y, x = (g.ravel() - (side - 1) / 2 for g in np.mgrid[0:side, 0:side])
    columns = [x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)]
    base, _ = np.linalg.qr(np.stack(columns, axis=1))
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
    return windows.mean(axis=1), _left_over(windows, 1)


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


def surface_residual(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], window_px: int = WINDOW_PX
) -> float:
    """Return the median residual to a quadratic surface, of the windows inside a mask.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres.
    mask : ndarray of bool, shape (H, W)
        The body.
    window_px : int
        Side of the windows.

    Returns
    -------
    float
        Metres; NaN when no whole window fits into the mask.
    """
    windows = _windows(np.where(mask, depth_m, np.float32(0)), window_px)
    return float(np.median(_left_over(windows, 2))) if len(windows) else float("nan")


def fill_inside(depth_m: NDArray[np.float32], mask: NDArray[np.bool_]) -> float:
    """Return the share of a mask's pixels that have a reading.

    Examples
    --------
    >>> fill_inside(np.array([[0.5, 0.0]], np.float32), np.array([[True, True]]))
    0.5
    """
    return float(valid_depth(depth_m[mask]).mean())


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
    sums = _left_over(_windows(np.where(whole, np.mean(burst, axis=0), 0), window_px), 1)
    single = [_left_over(_windows(np.where(whole, f, 0), window_px), 1) for f in burst]
    one, mean, n = float(np.mean(np.square(single))), float(np.mean(sums**2)), len(burst)
    # The mean of n frames keeps fixed + (1 - fixed) / n of the variance.
    return (mean / one - 1 / n) / (1 - 1 / n)


def edge_profile(
    depth_m: NDArray[np.float32],
    ground_m: NDArray[np.float64],
    mask: NDArray[np.bool_],
    towards: tuple[float, float] = (0.0, -1.0),
) -> EdgeProfile:
    """Measure how a body's depth leaks over its outline.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres; 0 where there is no reading.
    ground_m : ndarray of float64, shape (H, W)
        Depth of the ground that the body lies on, metres.
    mask : ndarray of bool, shape (H, W)
        The body.
    towards : tuple of float
        Only the parts of the outline count that face this way in the picture (u, v), within 45
        degrees.

    Returns
    -------
    EdgeProfile
        Over offsets of -14 to 20 pixels.

    Examples
    --------
    >>> depth = np.full((80, 80), 0.6, np.float32)
    >>> mask = np.zeros((80, 80), bool)
    >>> mask[30:70, 20:60] = True
    >>> depth[27:70, 20:60] = 0.5  # leaks 3 px over the upper edge
    >>> profile = edge_profile(depth, np.full((80, 80), 0.6), mask)
    >>> round(profile.crossing_px(0.5), 3)
    3.0
    """
    import cv2

    signed = np.where(mask, 0.5 - distances_inside(mask), distances_inside(~mask) - 0.5)
    slope_v, slope_u = np.gradient(cv2.GaussianBlur(signed.astype(np.float32), (0, 0), 2.0))
    faces = towards[0] * slope_u + towards[1] * slope_v
    facing = faces > np.cos(np.pi / 4) * np.hypot(slope_u, slope_v)
    valid, height = valid_depth(depth_m), ground_m - depth_m
    heights, invalid = [], []
    for offset in _OFFSETS_PX.tolist():
        ring = facing & (signed >= offset) & (signed < offset + 1)
        read = ring & valid
        heights.append(np.median(height[read]) if read.sum() >= 10 else np.nan)
        invalid.append(1 - read.sum() / ring.sum() if ring.any() else np.nan)
    inner = np.array(heights[:4])
    top = np.median(inner[~np.isnan(inner)]) if not np.isnan(inner).all() else np.nan
    return EdgeProfile(_OFFSETS_PX, np.array(heights) / top, np.array(invalid))
