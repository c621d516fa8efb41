"""Detect depth that lies beside the fruit it belongs to; pure functions of arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.geometry.axis import principal_axis
from cucumbervision.instances.masks import box_of_mask, mask_pixels, mask_window

if TYPE_CHECKING:
    from numpy.typing import NDArray

MIN_READINGS = 30
"""Number of readings without which depth says nothing."""

# Real fruit with correct depth do not exceed these limits; some drawn in heaps do, and most masks
# that are moved across by a radius.
_NEAREST_PERCENT, _NEAR_RADII, _SECTIONS = 20, 1.3, 5
_RADIUS_PX, _SHIFTS, _MOVED_RADII = 6.0, 13, 0.6
_ALIGNED, _BETTER, _LEAST_KNOWN = 1.0, 0.7, 0.3
_BESIDE_SCORES = -1.0, 0.8  # of a mask beside its fruit: more is on it, less is behind others
_WIDER = 0.7  # focal length of a D435's depth, relative to its colour's
_ALIGNED_AS_WIDER, _BETTER_AS_WIDER = 1.2, 0.8


def fits_better_elsewhere(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], radius_px: float, focal_px: float
) -> bool:
    """Return whether a mask fits its depth much better moved, or enlarged from a wider camera.

    The mask is moved in a window that extends the fruit by its shorter side.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres; 0 for no reading.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels, at least one.
    radius_px : float
        Largest distance of a pixel of the mask from its outline.
    focal_px : float
        Focal length, pixels.

    Examples
    --------
    >>> mask = np.zeros((120, 200), bool)
    >>> mask[50:70, 60:140] = True
    >>> depth_m = np.where(mask, 0.5, 0.7).astype(np.float32)
    >>> fits_better_elsewhere(depth_m, mask, 10.0, 600.0)
    False
    >>> fits_better_elsewhere(np.roll(depth_m, 12, axis=0), mask, 10.0, 600.0)
    True
    """
    x1, y1, x2, y2 = box_of_mask(mask)
    part = mask_window(mask, int(min(x2 - x1, y2 - y1)) + 7)
    if part is None:
        return False
    step = max(1, int(radius_px / (2 * _RADIUS_PX)))  # enough pixels to average over
    near = 1 + _NEAR_RADII * radius_px / focal_px
    mask, radius_px = mask[part][::step, ::step], radius_px / step
    scores = _scores(depth_m[part][::step, ::step], mask, radius_px, near)
    if scores is None:
        return False
    score = float(scores[_SHIFTS, _SHIFTS])
    least, most = _BESIDE_SCORES
    better = score + _BETTER
    if least <= score <= most and _is_best(
        scores, max(_ALIGNED, better), _MOVED_RADII * _RADIUS_PX
    ):
        return True
    scores = _scores(_as_wider(depth_m, part, step), mask, radius_px, near)
    better = score + _BETTER_AS_WIDER
    return scores is not None and _is_best(scores, max(_ALIGNED_AS_WIDER, better))


def _is_best(scores: NDArray[np.float32], least: float, least_moved: float = 0.0) -> bool:
    """Return whether the best score is high enough, at a place that is moved far enough."""
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    moved = np.abs(np.array(best) - _SHIFTS)
    # A best position at the border of the search may belong to another object.
    return bool(scores[best] >= least and np.hypot(*moved) >= least_moved and moved.max() < _SHIFTS)


def _as_wider(
    depth_m: NDArray[np.float32], part: tuple[slice, slice], step: int
) -> NDArray[np.float32]:
    """Return a part of a depth picture, enlarged about the middle as if nobody had aligned it."""
    import cv2

    height, width = depth_m.shape
    v, u = part
    scale = _WIDER * step
    turn = np.array(
        [
            [scale, 0.0, width / 2 + (u.start - width / 2) * _WIDER],
            [0.0, scale, height / 2 + (v.start - height / 2) * _WIDER],
        ]
    )
    size = -(-(u.stop - u.start) // step), -(-(v.stop - v.start) // step)
    nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(depth_m, turn, size, flags=nearest), np.float32)


def _scores(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], radius_px: float, near: float
) -> NDArray[np.float32] | None:
    """Return how well a mask fits the depth at each shift; None with too few readings.

    The score is the mean inside the mask minus the mean around it, where near readings count +1 and
    far ones -1; it is 2 for a free-standing fruit. Readings up to `near` times the distance of what
    is nearest are near.
    """
    import cv2

    read, side_px = valid_depth(depth_m), 2 * round(radius_px) + 1
    # A sum over squares is a dilation whose time does not grow with the square.
    sums = cv2.boxFilter(
        mask.astype(np.uint8), -1, (side_px, side_px), normalize=False, borderType=0
    )
    is_around = read & (sums > 0)
    if np.count_nonzero(is_around) < MIN_READINGS:
        return None
    # Relative to the nearest, because the distance at the mask may be that of another object.
    limit_m = near * _nearest_along(depth_m, mask, is_around)
    behind = np.where(depth_m < limit_m, np.float32(1), np.float32(-1)) * read
    # Six pixels per radius are enough to find the best position.
    scale = min(1.0, _RADIUS_PX / radius_px)
    size = [max(1, round(n * scale)) for n in mask.shape[::-1]]
    values, is_read, shape = (
        np.asarray(cv2.resize(np.asarray(part, np.float32), size, interpolation=cv2.INTER_AREA))
        for part in (behind, read, mask)
    )
    outer, inner = (np.asarray(cv2.dilate(shape, np.ones((n, n)))) for n in (7, 3))
    ring = np.clip(outer - inner, 0.0, 1.0)
    return _mean_under(values, is_read, shape) - _mean_under(values, is_read, ring)


def _nearest_along(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], is_around: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the depth of what is nearest as a straight line along a mask, for every pixel.

    A fruit that points at the camera is farther away at one end by more than its radius.
    """
    centre, axis = principal_axis(mask_pixels(mask))
    v, u = np.ogrid[: mask.shape[0], : mask.shape[1]]
    along = (u - centre[0]) * axis[0] + (v - centre[1]) * axis[1]
    places, readings_m = along[is_around], depth_m[is_around]
    bounds = np.linspace(places.min(), places.max(), _SECTIONS + 1)[1:-1]
    section = np.searchsorted(bounds, places)
    lines = [
        (places[section == k].mean(), np.percentile(readings_m[section == k], _NEAREST_PERCENT))
        for k in range(_SECTIONS)
        if np.count_nonzero(section == k) >= MIN_READINGS
    ]
    if len(lines) < 3:
        return np.full(mask.shape, np.percentile(readings_m, _NEAREST_PERCENT))
    # Theil and Sen: what hides one section does not turn the line.
    t = np.array([place for place, _ in lines])
    near_m = np.array([reading for _, reading in lines])
    i, j = np.triu_indices(len(t), 1)
    slope = np.median((near_m[j] - near_m[i]) / (t[j] - t[i]))
    return np.asarray(np.median(near_m - slope * t) + slope * along)


def _mean_under(
    values: NDArray[Any], is_read: NDArray[Any], weights: NDArray[Any]
) -> NDArray[np.float32]:
    """Return the weighted mean of the readings for each shift up to `_SHIFTS` pixels."""
    import cv2

    sums, counts = (
        np.asarray(cv2.matchTemplate(np.pad(part, _SHIFTS), weights, cv2.TM_CCORR))
        for part in (values, is_read)
    )
    least_weight = _LEAST_KNOWN * float(weights.sum())
    return np.asarray(sums / np.maximum(counts, max(least_weight, 1e-3)), np.float32)
