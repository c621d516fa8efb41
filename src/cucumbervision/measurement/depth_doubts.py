"""What a fruit's own picture tells of depth that is no depth of it: pure functions of arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.measurement.result import Flag

if TYPE_CHECKING:
    from numpy.typing import NDArray

_NEAREST_M = 0.12  # the nearest that any common depth camera reads (D405: 7 cm, D435: 17 cm)
_MIN_READINGS = 30
# Distance from the outline, as a share of the largest, of the middle and of the flanks. Of a tube
# the flanks lie 0.12 to 0.55 radii behind the middle, 0.26 by the median.
_MIDDLE, _FLANK = 0.75, (0.15, 0.5)
_HOLLOW = 0.08  # apparent radii that the middle lies behind the flanks
_NOISE_SD = 4.0  # standard errors of both medians
_PIECE = 0.1  # least share of the mask of a piece that counts
_GAP_BEHIND = 1.0  # diameters that the gap lies behind the fruit
_GAP_SHARE = 0.8  # of the gap's readings


def depth_doubts(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], focal_px: float
) -> tuple[Flag, ...]:
    """Return why depth in a fruit's mask cannot be its distance.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Depth aligned to colour, metres; 0 for no reading.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    focal_px : float
        Focal length, pixels.

    Returns
    -------
    tuple of Flag
        'depth-too-near': the fruit is nearer than any camera reads. 'depth-hollow': its middle lies
        behind its flanks, as where nearer is larger. 'depth-gap': the mask is of several pieces,
        and what lies between them is clearly behind, so that they are no one fruit.

    Examples
    --------
    >>> mask = np.zeros((40, 120), bool)
    >>> mask[10:30, 10:110] = True
    >>> depth_doubts(np.full((40, 120), 0.1, np.float32), mask, 600.0)
    (<Flag.DEPTH_TOO_NEAR: 'depth-too-near'>,)
    """
    readings = depth_m[mask & (depth_m > 0)]
    if readings.size < _MIN_READINGS:
        return ()
    distance_m = float(np.median(readings))
    doubts = {
        Flag.DEPTH_TOO_NEAR: distance_m < _NEAREST_M,
        Flag.DEPTH_HOLLOW: _is_hollow(depth_m, mask, distance_m / focal_px),
        Flag.DEPTH_GAP: _has_gap(depth_m, mask, distance_m, focal_px),
    }
    return tuple(flag for flag, holds in doubts.items() if holds)


def _is_hollow(depth_m: NDArray[np.float32], mask: NDArray[np.bool_], pixel_m: float) -> bool:
    """Return whether the middle of a mask lies behind its flanks, beyond what noise explains."""
    import cv2

    inside = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    radius_px = float(inside.max())
    share, known = inside / radius_px, valid_depth(depth_m)
    middle = depth_m[known & (share >= _MIDDLE)]
    flank = depth_m[known & (share >= _FLANK[0]) & (share <= _FLANK[1])]
    if min(middle.size, flank.size) < _MIN_READINGS:
        return False
    depth_behind_m = float(np.median(middle) - np.median(flank))
    error_m = np.hypot(_median_error(middle), _median_error(flank))
    return bool(depth_behind_m > max(_HOLLOW * radius_px * pixel_m, _NOISE_SD * error_m))


def _median_error(values: NDArray[np.float32]) -> float:
    """Return the standard error of a median, by the values' median deviation."""
    spread = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    return 1.2533 * spread / float(np.sqrt(values.size))


def _has_gap(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], distance_m: float, focal_px: float
) -> bool:
    """Return whether what lies between a mask's pieces is clearly behind them."""
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = stats[1:count, cv2.CC_STAT_AREA]
    pieces = 1 + np.flatnonzero(areas > _PIECE * areas.sum())
    if len(pieces) < 2:
        return False
    whole = np.isin(labels, pieces)
    rows, columns = np.nonzero(whole)
    outline = cv2.convexHull(np.column_stack([columns, rows]).astype(np.int32))
    hull = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), outline, 1).astype(bool)
    width_px = 2.0 * float(cv2.distanceTransform(whole.astype(np.uint8), cv2.DIST_L2, 3).max())
    near = cv2.dilate(whole.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    between = depth_m[hull & ~near & valid_depth(depth_m)]
    if between.size < _MIN_READINGS:
        return False
    limit_m = distance_m + _GAP_BEHIND * width_px * distance_m / focal_px
    return float((between > limit_m).mean()) >= _GAP_SHARE
