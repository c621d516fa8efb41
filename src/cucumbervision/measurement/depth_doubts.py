"""What a fruit's own picture tells of depth that is no depth of it: pure functions of arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.instances.masks import box_of_mask, distances_inside, mask_window
from cucumbervision.measurement.flags import Flag

if TYPE_CHECKING:
    from numpy.typing import NDArray

_NEAREST_M = 0.12  # the nearest that any common depth camera reads (D405: 7 cm, D435: 17 cm)
_MIN_READINGS = 30
# Distance from the outline, as a share of the largest, of the middle and of the flanks. Of a tube
# the flanks lie 0.12 to 0.55 radii behind the middle, 0.26 by the median.
_MIDDLE, _FLANK = 0.75, (0.15, 0.5)
_HOLLOW = 0.08  # apparent radii that the middle lies behind the flanks
# Stereo cameras read thin fruit between leaves hollow, too; but what surrounds those is not nearer.
_AROUND, _NEARER_SHARE = (0.3, 1.0), 0.85  # radii beyond the outline; share of the readings there
_NOISE_SD = 4.0  # standard errors of both medians
_PART = 0.1  # least share of the mask of a part that counts
_WAIST = 0.72  # of the largest radius: what is narrower between wider parts
_GAP_BEHIND = 1.0  # diameters that the gap lies behind the fruit
_LONGER = 2.5  # most that the gap is as long as where it is shortest
# Radii: the ring of the plane; how far any fruit stands out (real ones 1.4 to 2.5 before a table),
# and the roughness of planes (0.3 under printed paper, 0.4 and more between leaves).
_PLANE, _STANDS_OUT, _ROUGH, _PLANE_STEPS = (0.15, 1.2), 0.5, 0.3, 4
_PLANE_READINGS = 2000  # more tell no more of a plane
# Of 48 real fruit with true depth one detection that is no fruit passes these limits; moved by a
# radius, about half do before an open background, and none where all around is as near.
_NEAREST_PERCENT, _NEAR_RADII = 20, 1.3
_RADIUS_PX, _SHIFTS, _MOVED_RADII = 6.0, 13, 0.6
_ALIGNED, _BETTER, _LEAST_KNOWN = 1.0, 0.5, 0.3
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
        behind its flanks, and itself behind what surrounds it, as where nearer is larger.
        'depth-gap': the mask is of several parts, and what lies between them is clearly behind,
        so that they are no one fruit. 'depth-unaligned': nothing stands out from the plane around
        the mask, or the mask fits what is near in depth far better at another place.

    Examples
    --------
    >>> mask = np.zeros((40, 120), bool)
    >>> mask[10:30, 10:110] = True
    >>> depth_doubts(np.where(mask, 0.1, 0.4).astype(np.float32), mask, 600.0)
    (<Flag.DEPTH_TOO_NEAR: 'depth-too-near'>,)
    """
    readings = depth_m[mask & (depth_m > 0)]
    if readings.size < _MIN_READINGS:
        return ()
    body = _Body.of(depth_m, mask, float(np.median(readings)), focal_px)
    doubts = {
        Flag.DEPTH_TOO_NEAR: body.distance_m < _NEAREST_M,
        Flag.DEPTH_HOLLOW: _is_hollow(body),
        Flag.DEPTH_GAP: _has_gap(body),
        Flag.DEPTH_UNALIGNED: _is_flat(body) or _is_beside(body),
    }
    return tuple(flag for flag, holds in doubts.items() if holds)


@dataclass(frozen=True, eq=False)
class _Body:
    """A fruit in the part of the picture around it, as far as its shorter side beyond it.

    Distances from the outline, inside and outside it, are in pixels.
    """

    depth_m: NDArray[np.float32]
    mask: NDArray[np.bool_]
    read: NDArray[np.bool_]
    inside_px: NDArray[np.float32]
    outside_px: NDArray[np.float32]
    radius_px: float
    radius_m: float
    distance_m: float

    @classmethod
    def of(
        cls,
        depth_m: NDArray[np.float32],
        mask: NDArray[np.bool_],
        distance_m: float,
        focal_px: float,
    ) -> _Body:
        x1, y1, x2, y2 = box_of_mask(mask)
        part = mask_window(mask, int(min(x2 - x1, y2 - y1)) + 7)
        depth_m, mask = depth_m[part], mask[part]
        inside_px = distances_inside(np.pad(mask, 1))[1:-1, 1:-1]
        radius_px = float(inside_px.max())
        return cls(
            depth_m,
            mask,
            valid_depth(depth_m),
            inside_px,
            distances_inside(~mask),
            radius_px,
            radius_px * distance_m / focal_px,
            distance_m,
        )


def _is_hollow(body: _Body) -> bool:
    """Return whether a mask's middle lies behind its flanks, and what is around lies before it."""
    share = body.inside_px / body.radius_px
    middle = body.depth_m[body.read & (share >= _MIDDLE)]
    flank = body.depth_m[body.read & (share >= _FLANK[0]) & (share <= _FLANK[1])]
    if min(middle.size, flank.size) < _MIN_READINGS:
        return False
    depth_behind_m = float(np.median(middle) - np.median(flank))
    error_m = np.hypot(_median_error(middle), _median_error(flank))
    if depth_behind_m <= max(_HOLLOW * body.radius_m, _NOISE_SD * error_m):
        return False
    outside = body.outside_px / body.radius_px
    around = body.depth_m[body.read & (outside > _AROUND[0]) & (outside < _AROUND[1])]
    nearer = around < body.distance_m
    return around.size >= _MIN_READINGS and float(nearer.mean()) >= _NEARER_SHARE


def _median_error(values: NDArray[np.float32]) -> float:
    """Return the standard error of a median, by the values' median deviation."""
    return 1.2533 * _robust_sd(values) / float(np.sqrt(values.size))


def _has_gap(body: _Body) -> bool:
    """Return whether what lies between a mask's parts, along its axis, is clearly behind them.

    Parts are its pieces, or what a waist parts: fruit end to end in one outline.
    """
    width_px = 2.0 * body.radius_px
    limit_m = body.distance_m + _GAP_BEHIND * 2.0 * body.radius_m
    worn = _parts(body.inside_px >= _WAIST * body.radius_px)
    for parts in (_parts(body.mask), worn if worn is None else _grown(worn, body.mask, width_px)):
        if parts is None:
            continue
        depths_m = body.depth_m[_between(parts, width_px) & ~body.mask & body.read]
        if depths_m.size >= _MIN_READINGS and float((depths_m > limit_m).mean()) >= _GAP_SHARE:
            return True
    return False


def _parts(core: NDArray[np.bool_]) -> NDArray[np.uint8] | None:
    """Return a mask's large parts, numbered from 1, 0 elsewhere; None if it has one alone."""
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(core.astype(np.uint8))
    areas = stats[1:count, cv2.CC_STAT_AREA]
    large = 1 + np.flatnonzero(areas > _PART * areas.sum())
    if len(large) < 2:
        return None
    return np.where(np.isin(labels, large), labels, 0).astype(np.uint8)


def _grown(parts: NDArray[np.uint8], mask: NDArray[np.bool_], width_px: float) -> NDArray[np.uint8]:
    """Return parts grown to the outline again, by what they had been worn off."""
    import cv2

    reach_px = 2 * round(_WAIST * width_px / 2) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach_px, reach_px))
    return np.where(mask, cv2.dilate(parts, disc), 0).astype(np.uint8)


def _between(parts: NDArray[np.uint8], width_px: float) -> NDArray[np.bool_]:
    """Return the pixels with one part before them along the parts' axis and another after."""
    import cv2

    points = np.argwhere(parts)[:, ::-1].astype(np.float64)
    centre = points.mean(axis=0)
    x, y = np.linalg.eigh(np.cov((points - centre).T))[1][:, 1]
    reach = int(np.abs(points - centre).max() * 1.5) + 2
    # To a picture in which the axis runs down the columns, and back.
    turned = np.array([[y, -x, reach], [x, y, reach]], np.float64)
    turned[:, 2] -= turned[:, :2] @ centre
    size, nearest = (2 * reach, 2 * reach), cv2.INTER_NEAREST
    upright = cv2.warpAffine(parts, turned, size, flags=nearest)
    above, below = _last_row(upright), len(upright) - 1 - _last_row(upright[::-1])[::-1]
    before = np.take_along_axis(upright, above, axis=0)
    after = np.take_along_axis(upright, below, axis=0)
    gap = (upright == 0) & (before > 0) & (after > 0) & (before != after)
    # Beside the inner side of a bend the way from part to part is long and outside the fruit.
    long_px = below - above
    shortest_px = long_px.min(where=gap, initial=len(upright))
    gap &= long_px <= max(_LONGER * shortest_px, width_px)
    # Edges of both parts read as something between: a pixel of each is left out.
    gap = cv2.erode(gap.astype(np.uint8), np.ones((3, 1), np.uint8))
    height, width = parts.shape
    gap_in_picture = cv2.warpAffine(
        gap, turned, (width, height), flags=nearest | cv2.WARP_INVERSE_MAP
    )
    return np.asarray(gap_in_picture, bool)


def _last_row(pieces: NDArray[Any]) -> NDArray[np.intp]:
    """Return, for each pixel, the row of the nearest labelled pixel above it; 0 for none."""
    rows = np.where(pieces > 0, np.arange(len(pieces))[:, None], 0)
    return np.asarray(np.maximum.accumulate(rows), np.intp)


def _is_flat(body: _Body) -> bool:
    """Return whether a mask lies in the plane of what surrounds it, so that no body is there."""
    outside = body.outside_px / body.radius_px
    around = body.read & (outside > _PLANE[0]) & (outside < _PLANE[1])
    middle = body.read & (body.inside_px > 0.5 * body.radius_px)
    if min(np.count_nonzero(around), np.count_nonzero(middle)) < _MIN_READINGS:
        return False
    spacing = max(1, np.count_nonzero(around) // _PLANE_READINGS)
    places, z_m = _with_one(around)[::spacing], body.depth_m[around][::spacing]
    fits = np.ones(len(z_m), bool)
    for _ in range(_PLANE_STEPS):
        plane = np.linalg.lstsq(places[fits], z_m[fits], rcond=None)[0]
        gap_m = z_m - places @ plane
        around_sd_m = _robust_sd(gap_m[fits])
        fits = np.abs(gap_m - np.median(gap_m[fits])) <= 3.0 * around_sd_m + 1e-4
    ahead_m = body.depth_m[middle] - _with_one(middle) @ plane
    spread_m = max(around_sd_m, _robust_sd(ahead_m))
    stands_out_m = abs(float(np.median(ahead_m)))
    return stands_out_m < _STANDS_OUT * body.radius_m and spread_m < _ROUGH * body.radius_m


def _with_one(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return (u, v, 1) of a mask's pixels."""
    v, u = np.nonzero(mask)
    return np.stack([u, v, np.ones(len(u))], axis=1).astype(np.float64)


def _robust_sd(values: NDArray[np.floating[Any]]) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def _is_beside(body: _Body) -> bool:
    """Return whether the mask, moved, holds what is near and is bordered by what is behind.

    The score of a place is the mean inside less the mean around of +1 for near and -1 for behind,
    of what is read; it is 2 for a fruit that stands free.
    """
    import cv2

    steps = round(body.radius_px)
    reach = cv2.dilate(body.mask.astype(np.uint8), np.ones((3, 3)), iterations=steps) > 0
    readings_m = body.depth_m[body.read & reach]
    if readings_m.size < _MIN_READINGS:
        return False
    near_m = float(np.percentile(readings_m, _NEAREST_PERCENT))
    # Radii at the nearest distance, not at the mask's: there it may be of something else.
    limit_m = near_m * (1 + _NEAR_RADII * body.radius_m / body.distance_m)
    behind = np.where(body.read, np.where(body.depth_m < limit_m, 1.0, -1.0), 0.0)
    # Six pixels a radius are enough to find where they lie together.
    scale = min(1.0, _RADIUS_PX / body.radius_px)
    size = [max(1, round(n * scale)) for n in body.mask.shape[::-1]]
    values, is_read, shape = (
        np.asarray(cv2.resize(np.asarray(part, np.float32), size, interpolation=cv2.INTER_AREA))
        for part in (behind, body.read, body.mask)
    )
    outer, inner = (np.asarray(cv2.dilate(shape, np.ones((n, n)))) for n in (7, 3))
    ring = np.clip(outer - inner, 0.0, 1.0)
    scores = _mean_under(values, is_read, shape) - _mean_under(values, is_read, ring)
    best = np.array(np.unravel_index(int(scores.argmax()), scores.shape))
    moved = np.abs(best - _SHIFTS)
    better = float(scores[tuple(best)] - scores[_SHIFTS, _SHIFTS])
    # A best place at the border of the search may be any other thing.
    return bool(
        scores.max() >= _ALIGNED
        and better >= _BETTER
        and np.hypot(*moved) >= _MOVED_RADII * _RADIUS_PX
        and moved.max() < _SHIFTS
    )


def _mean_under(
    values: NDArray[Any], is_read: NDArray[Any], weights: NDArray[Any]
) -> NDArray[np.float32]:
    """Return the mean of what is known under weights, for each shift up to `_SHIFTS` pixels."""
    import cv2

    sums, counts = (
        np.asarray(cv2.matchTemplate(np.pad(part, _SHIFTS), weights, cv2.TM_CCORR))
        for part in (values, is_read)
    )
    least_weight = _LEAST_KNOWN * float(weights.sum())
    return np.asarray(sums / np.maximum(counts, max(least_weight, 1e-3)), np.float32)
