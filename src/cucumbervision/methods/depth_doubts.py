"""Detect depth and outlines that cannot be those of one fruit; pure functions of arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.fruit.masks import box_of_mask, distances_inside, mask_pixels, mask_window
from cucumbervision.methods.flags import Flag
from cucumbervision.tube.evidence import quick_median
from cucumbervision.tube.shape import principal_axis

if TYPE_CHECKING:
    from numpy.typing import NDArray

LEAST_FILL = 0.5
"""Share of a fruit's pixels with depth below which its length is doubtful.

Nearer than its range a camera reads a few pixels of the rim, which are wrong.
"""

MIN_READINGS = 30
"""Number of readings without which depth says nothing."""

_BODY_PX = 16.0  # of a radius: more pixels say no more
_NEAREST_M = 0.12  # minimum distance of common depth cameras (D405: 7 cm, D435: 17 cm)
# Ranges of the middle and the flanks: distance from the outline relative to the largest. The flanks
# of a tube lie 0.12 to 0.55 radii behind the middle, 0.26 in the median.
_MIDDLE_FROM, _FLANK_RANGE = 0.75, (0.15, 0.5)
_HOLLOW_RADII = 0.08  # threshold in apparent radii: the middle lies behind the flanks by more
# Stereo depth of thin fruit between leaves is hollow, too, but their surroundings are not nearer.
_SURROUNDING_RADII = (0.3, 1.0)  # beyond the outline
_NEARER_SHARE = 0.85  # of the readings there
_NOISE_SD = 4.0  # standard errors of both medians
# Size of a piece, relative to the mask, and of a part on one side of a waist. A line that joins
# pieces is no part of them.
_LEAST_PIECE, _LEAST_PART, _LINE_RADII = 0.01, 0.1, 0.12
_WAIST_SHARE = 0.72  # of the largest radius: a narrower place between wider parts is a waist
_WAIST_SIDE_SHARE = 0.1  # of a waist's gap, on the side with less of it
_GAP_BEHIND = 1.0  # minimum distance of the gap behind the fruit, in diameters
_LONGEST_GAP_RATIO = 2.5  # maximum length of the gap relative to its shortest length
# In radii: the ring that defines the plane; the minimum height of a fruit above it (real ones 1.4
# to 2.5 above a table); the roughness of planes (0.3 for printed paper, at least 0.4 for leaves).
_PLANE_RING_RADII, _LEAST_HEIGHT_RADII, _ROUGHNESS_RADII, _PLANE_STEPS = (0.15, 1.2), 0.5, 0.3, 4
_PLANE_READINGS = 2000  # more readings do not improve the plane
_GAP_SHARE = 0.8  # share of the readings in the gap
# Readings in the outline that lie so many radii behind the surface around them, and their share in
# three quarters of the sections: 0.106 where outlines are 3 px too wide, up to 0.09 on drawn fruit
# at the rim of far ones, 0.0 on real ones.
_BEHIND_RADII, _BEHIND_SHARE, _BEHIND_SECTIONS = 4.0, 0.1, 12
_ONE_VALUE_SHARE = 0.6  # real skin has one value on at most 0.23 of its pixels
_STEM_WIDTH, _STEM_RADII = 0.35, 1.0  # of the largest width; length of such a narrow end
# Surface that goes on: in a ring of pixels (a camera's own blur makes 0.94), and beyond an end.
_RING_PX, _RING_SHARE = (3, 7), 0.97
_BEYOND_RADII, _BEYOND_SHARE, _SURFACE_RADII, _SAME_COLOR = (0.2, 0.7), 0.75, 0.5, 45.0


def depth_doubts(
    depth_m: NDArray[np.float32],
    mask: NDArray[np.bool_],
    focal_px: float,
    color: NDArray[np.uint8] | None = None,
) -> tuple[Flag, ...]:
    """Return flags for depth that cannot be the distance of a fruit, and outlines off their fruit.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Depth aligned to colour, metres; 0 for no reading.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    focal_px : float
        Focal length, pixels.
    color : ndarray of uint8, shape (H, W, 3), optional
        The picture: what goes on beyond an end has the fruit's colour.

    Returns
    -------
    tuple of Flag
        'depth-too-near': the fruit is nearer than the minimum distance of any camera.
        'depth-sparse': less than half of its pixels have a reading.
        'depth-hollow': its middle lies behind its flanks, and the fruit behind its surroundings,
        as in inverted depth. 'depth-gap': the mask has several parts, and the background between
        them is clearly farther away, so that they are different fruit. 'depth-unaligned': the fruit
        does not stand out from the plane around it, part of the mask lies far behind it nearly all
        along, or the mask fits the near depth much better at another position. 'depth-coarse': its
        readings differ in steps of over 1.2 % of the distance, or are one value, or the picture
        holds whole millimetres up to 255; not of a fruit that is too near. 'outline-stem': an end
        of the mask is a third as wide as the fruit. 'outline-short': the surface goes on beyond it.

    Examples
    --------
    >>> mask = np.zeros((40, 120), bool)
    >>> mask[10:30, 10:110] = True
    >>> depth_doubts(np.where(mask, 0.1, 0.4).astype(np.float32), mask, 600.0)
    (<Flag.DEPTH_TOO_NEAR: 'depth-too-near'>,)
    >>> rim = np.where(mask, 0.5, 0.7).astype(np.float32)
    >>> rim[13:27, 13:107] = 0  # nearer than the camera's range
    >>> depth_doubts(rim, mask, 600.0)
    (<Flag.DEPTH_SPARSE: 'depth-sparse'>,)
    """
    window = mask_window(mask)
    if window is None:
        return ()
    readings = depth_m[window][mask[window] & (depth_m[window] > 0)]
    is_sparse = readings.size < LEAST_FILL * np.count_nonzero(mask[window])
    if readings.size < MIN_READINGS:
        return (Flag.DEPTH_SPARSE,) if is_sparse else ()
    body = _Body.of(depth_m, mask, float(quick_median(readings)), focal_px)
    is_too_near = body.distance_m < _NEAREST_M
    doubts = {
        Flag.DEPTH_TOO_NEAR: is_too_near,
        Flag.DEPTH_SPARSE: is_sparse,
        Flag.DEPTH_HOLLOW: _is_hollow(body),
        Flag.DEPTH_GAP: _has_gap(body),
        Flag.DEPTH_UNALIGNED: _is_flat(body)
        or _lies_behind(body)
        or _fits_better_elsewhere(depth_m, body),
        Flag.DEPTH_COARSE: not is_too_near
        and has_coarse_steps(depth_m, readings, may_be_one=not is_sparse),
    }
    # Wrong depth says nothing of an outline.
    doubts[Flag.OUTLINE_STEM] = not any(doubts.values()) and _has_stem(body)
    doubts[Flag.OUTLINE_SHORT] = not any(doubts.values()) and (
        _goes_on_around(depth_m, mask, body) or any(_goes_on(body, end, color) for end in (-1, 1))
    )
    return tuple(flag for flag, holds in doubts.items() if holds)


@dataclass(frozen=True, eq=False)
class _Body:
    """A fruit in a window of the picture, of every `step`-th pixel; distances are in those pixels.

    `pixels` are those of the mask; `near_m` is the depth of what is nearest along the fruit, as a
    line: its value at `centre`, and its slope along `axis`.
    """

    depth_m: NDArray[np.float32]
    mask: NDArray[np.bool_]
    read: NDArray[np.bool_]
    inside_px: NDArray[np.float32]
    outside_px: NDArray[np.float32]
    pixels: NDArray[np.float64]
    centre: NDArray[np.float64]
    axis: NDArray[np.float64]
    radius_px: float
    radius_m: float
    distance_m: float
    part: tuple[slice, slice]
    step: int

    @classmethod
    def of(
        cls,
        depth_m: NDArray[np.float32],
        mask: NDArray[np.bool_],
        distance_m: float,
        focal_px: float,
    ) -> _Body:
        x1, y1, x2, y2 = box_of_mask(mask)
        part = mask_window(mask, int(min(x2 - x1, y2 - y1)) + 7) or (slice(None), slice(None))
        about_px = np.count_nonzero(mask[part]) / (2 * np.hypot(x2 - x1, y2 - y1))
        step = max(1, int(about_px / _BODY_PX))
        depth_m, mask = depth_m[part][::step, ::step], mask[part][::step, ::step]
        # The outline is nearer than the first pixel beyond it that is left.
        nearer_px = np.float32(0.5 - 0.5 / step)
        inside_px = distances_inside(np.pad(mask, 1))[1:-1, 1:-1] - nearer_px
        outside_px = distances_inside(~mask) - nearer_px
        radius_px, pixels = float(inside_px.max()), mask_pixels(mask)
        radius_m = radius_px * step * distance_m / focal_px
        arrays = depth_m, mask, valid_depth(depth_m), inside_px, outside_px, pixels
        sizes = radius_px, radius_m, distance_m, part, step
        return cls(*(*arrays, *principal_axis(pixels), *sizes))

    @cached_property
    def line(self) -> tuple[float, float] | None:
        """Its own `near_line`."""
        return self.near_line(self.depth_m, self.read)

    def near_line(
        self, depth_m: NDArray[np.float32], read: NDArray[np.bool_]
    ) -> tuple[float, float] | None:
        """Return the depth of what is nearest along the fruit: at its centre, and its slope.

        A fruit that points at the camera is farther away at one end by more than its radius. None
        with too few readings.
        """
        v, u = np.nonzero(read & (self.outside_px <= self.radius_px))
        if len(v) < MIN_READINGS:
            return None
        v, u = (rows[:: max(1, len(v) // _PLANE_READINGS)] for rows in (v, u))
        places, readings_m = self.along[v, u], depth_m[v, u]
        section = _sections(places, _SECTIONS)
        lines = [
            (places[section == k].mean(), np.percentile(readings_m[section == k], _NEAREST_PERCENT))
            for k in range(_SECTIONS)
            if np.count_nonzero(section == k) >= MIN_READINGS
        ]
        if len(lines) < 3:
            return float(np.percentile(readings_m, _NEAREST_PERCENT)), 0.0
        # Theil and Sen: what hides one section does not turn the line.
        t, near_m = np.array(lines).T
        i, j = np.triu_indices(len(t), 1)
        slope = float(np.median((near_m[j] - near_m[i]) / (t[j] - t[i])))
        return float(np.median(near_m - slope * t)), slope

    @cached_property
    def along(self) -> NDArray[np.float64]:
        """The place of each pixel of the window along the axis, from the centre."""
        v, u = np.ogrid[: self.mask.shape[0], : self.mask.shape[1]]
        return np.asarray((u - self.centre[0]) * self.axis[0] + (v - self.centre[1]) * self.axis[1])

    def off_m(self, depth_m: NDArray[Any], along: NDArray[Any]) -> NDArray[np.float64]:
        """Return how far readings lie behind the line of what is nearest; NaN without a line."""
        start_m, slope = self.line or (np.nan, 0.0)
        return np.asarray(depth_m - start_m - slope * along)


def _is_hollow(body: _Body) -> bool:
    """Return whether a mask's middle lies behind its flanks, and its surroundings are nearer."""
    share = body.inside_px / body.radius_px
    middle = body.depth_m[body.read & (share >= _MIDDLE_FROM)]
    flank = body.depth_m[body.read & (share >= _FLANK_RANGE[0]) & (share <= _FLANK_RANGE[1])]
    if min(middle.size, flank.size) < MIN_READINGS:
        return False
    depth_behind_m = float(quick_median(middle) - quick_median(flank))
    error_m = np.hypot(_median_error(middle), _median_error(flank))
    if depth_behind_m <= max(_HOLLOW_RADII * body.radius_m, _NOISE_SD * error_m):
        return False
    outside = body.outside_px / body.radius_px
    around = body.depth_m[
        body.read & (outside > _SURROUNDING_RADII[0]) & (outside < _SURROUNDING_RADII[1])
    ]
    nearer = around < body.distance_m
    return around.size >= MIN_READINGS and float(nearer.mean()) >= _NEARER_SHARE


def _median_error(values: NDArray[np.float32]) -> float:
    """Return the standard error of a median, from the median absolute deviation."""
    return 1.2533 * _robust_sd(values) / float(np.sqrt(values.size))


def _has_gap(body: _Body) -> bool:
    """Return whether the depth between a mask's parts, along its axis, is clearly larger.

    Parts are connected components, or sections on both sides of a waist (two fruit end to end).
    """
    width_px = 2.0 * body.radius_px
    limit_m = body.distance_m + _GAP_BEHIND * 2.0 * body.radius_m

    def is_behind(gap: NDArray[np.bool_]) -> bool:
        depths_m = body.depth_m[gap & body.read]
        return depths_m.size >= MIN_READINGS and float((depths_m > limit_m).mean()) >= _GAP_SHARE

    pieces = _parts(body.inside_px > _LINE_RADII * body.radius_px, _LEAST_PIECE)
    if pieces is not None and is_behind(_between(pieces, width_px) & ~body.mask):
        return True
    worn = _parts(body.inside_px >= _WAIST_SHARE * body.radius_px, _LEAST_PART)
    if worn is None:
        return False
    gap = _between(_grown(worn, body.mask, width_px), width_px) & ~body.mask
    return is_behind(gap) and _is_on_both_sides(gap, body)


def _is_on_both_sides(gap: NDArray[np.bool_], body: _Body) -> bool:
    """Return whether a gap lies on both sides of a mask; a leaf or tendril notches one side."""
    across = np.array([-body.axis[1], body.axis[0]])
    of_mask, of_gap = body.pixels - body.centre, mask_pixels(gap) - body.centre
    rows = np.rint(of_mask @ body.axis).astype(np.intp)
    first, counts = rows.min(), np.bincount(rows - rows.min())
    middle_px = np.bincount(rows - first, of_mask @ across) / np.maximum(counts, 1)
    gap_rows = np.clip(np.rint(of_gap @ body.axis).astype(np.intp) - first, 0, len(counts) - 1)
    share = float((of_gap @ across > middle_px[gap_rows]).mean())
    return min(share, 1.0 - share) >= _WAIST_SIDE_SHARE


def _parts(core: NDArray[np.bool_], least: float) -> NDArray[np.uint8] | None:
    """Return a mask's large parts, numbered from 1, 0 elsewhere; None if there is only one."""
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(core.astype(np.uint8))
    areas = stats[1:count, cv2.CC_STAT_AREA]
    large = 1 + np.flatnonzero(areas > least * areas.sum())
    if len(large) < 2:
        return None
    return np.where(np.isin(labels, large), labels, 0).astype(np.uint8)


def _grown(parts: NDArray[np.uint8], mask: NDArray[np.bool_], width_px: float) -> NDArray[np.uint8]:
    """Return eroded parts, grown back to the outline."""
    import cv2

    reach_px = 2 * round(_WAIST_SHARE * width_px / 2) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach_px, reach_px))
    return np.where(mask, cv2.dilate(parts, disc), 0).astype(np.uint8)


def _between(parts: NDArray[np.uint8], width_px: float) -> NDArray[np.bool_]:
    """Return the pixels that lie between two parts along the axis of the parts."""
    import cv2

    points = mask_pixels(parts > 0)
    centre, (x, y) = principal_axis(points)
    reach = int(np.abs(points - centre).max() * 1.5) + 2
    # Rotate so that the axis runs along the columns, and back.
    turned = np.array([[y, -x, reach], [x, y, reach]], np.float64)
    turned[:, 2] -= turned[:, :2] @ centre
    size, nearest = (2 * reach, 2 * reach), cv2.INTER_NEAREST
    upright = cv2.warpAffine(parts, turned, size, flags=nearest)
    above, below = _last_row(upright), len(upright) - 1 - _last_row(upright[::-1])[::-1]
    before = np.take_along_axis(upright, above, axis=0)
    after = np.take_along_axis(upright, below, axis=0)
    gap = (upright == 0) & (before > 0) & (after > 0) & (before != after)
    # On the inner side of a bend, the path between the parts is long and outside the fruit.
    long_px = below - above
    shortest_px = long_px.min(where=gap, initial=len(upright))
    gap &= long_px <= max(_LONGEST_GAP_RATIO * shortest_px, width_px)
    # Depth at the edges is a mixture: one pixel of each part is omitted.
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
    """Return whether a mask lies in the plane of its surroundings, so that it is no body."""
    outside = body.outside_px / body.radius_px
    around = body.read & (outside > _PLANE_RING_RADII[0]) & (outside < _PLANE_RING_RADII[1])
    middle = body.read & (body.inside_px > 0.5 * body.radius_px)
    if min(np.count_nonzero(around), np.count_nonzero(middle)) < MIN_READINGS:
        return False
    spacing = max(1, int(np.count_nonzero(around)) // _PLANE_READINGS)
    places, z_m = _with_one(around, spacing), body.depth_m[around][::spacing]
    fits = np.ones(len(z_m), bool)
    for _ in range(_PLANE_STEPS):
        plane = np.linalg.lstsq(places[fits], z_m[fits], rcond=None)[0]
        gap_m = z_m - places @ plane
        around_sd_m = _robust_sd(gap_m[fits])
        fits = np.abs(gap_m - quick_median(gap_m[fits])) <= 3.0 * around_sd_m + 1e-4
    ahead_m = body.depth_m[middle] - _with_one(middle) @ plane
    spread_m = max(around_sd_m, _robust_sd(ahead_m))
    stands_out_m = abs(float(quick_median(ahead_m)))
    return (
        stands_out_m < _LEAST_HEIGHT_RADII * body.radius_m
        and spread_m < _ROUGHNESS_RADII * body.radius_m
    )


def _with_one(mask: NDArray[np.bool_], spacing: int = 1) -> NDArray[np.float64]:
    """Return the homogeneous coordinates (u, v, 1) of every `spacing`-th pixel of a mask."""
    v, u = (places[::spacing] for places in np.nonzero(mask))
    return np.stack([u, v, np.ones(len(u))], axis=1).astype(np.float64)


def _robust_sd(values: NDArray[np.floating[Any]]) -> float:
    return 1.4826 * float(quick_median(np.abs(values - quick_median(values))))


def _lies_behind(body: _Body) -> bool:
    """Return whether a mask lies partly on what is far behind, nearly all along the fruit."""
    import cv2

    read = body.mask & body.read
    if np.count_nonzero(read) < MIN_READINGS:
        return False
    surface_m = cv2.medianBlur(np.where(read, body.depth_m, np.float32(1e3)), 5)
    side_px = 2 * round(body.radius_px) + 1
    near_m = np.asarray(cv2.erode(surface_m, np.ones((side_px, side_px), np.uint8)))
    behind = (body.depth_m > near_m + _BEHIND_RADII * body.radius_m)[read]
    section = _sections(body.along[read], _BEHIND_SECTIONS)
    counts, counts_behind = np.bincount(section), np.bincount(section, behind)
    return float(np.quantile(counts_behind / np.maximum(counts, 1), 0.25)) >= _BEHIND_SHARE


def _sections(places: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    """Return for each place along a fruit in which of so many equal sections it lies."""
    bounds = np.linspace(places.min(), places.max(), count + 1)[1:-1]
    return np.asarray(np.searchsorted(bounds, places), np.intp)


def _has_stem(body: _Body) -> bool:
    """Return whether an end of a mask is much narrower than the fruit, before what is behind."""
    along = body.along[body.mask]
    rows = np.rint(along - along.min()).astype(np.intp)
    wide = np.flatnonzero(np.bincount(rows) >= _STEM_WIDTH * 2.0 * body.radius_px)
    # A leaf that hides most of the width is nearer than the fruit.
    beside = (body.outside_px > 1.0) & (body.outside_px < body.radius_px) & body.read
    places = body.along[beside]
    clear = body.off_m(body.depth_m[beside], places) > body.radius_m
    for narrow in (along[rows < wide[0]], along[rows > wide[-1]]) if len(wide) else ():
        if len(narrow) and np.ptp(narrow) >= _STEM_RADII * body.radius_px:
            first, last = np.quantile(narrow, [0.1, 0.9])
            clear_there = clear[(places > first) & (places < last)]
            if len(clear_there) >= MIN_READINGS and clear_there.mean() >= _NEARER_SHARE:
                return True
    return False


def _goes_on_around(depth_m: NDArray[np.float32], mask: NDArray[np.bool_], body: _Body) -> bool:
    """Return whether the fruit's surface goes on all round a mask that was drawn too narrow."""
    import cv2

    window = mask_window(mask, _RING_PX[1]) or body.part
    within, wider = (
        cv2.dilate(mask[window].view(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size))
        for size in ((side_px, side_px) for side_px in _RING_PX)
    )
    v, u = np.nonzero((wider > within) & valid_depth(depth_m[window]))
    corner = [window[1].start - body.part[1].start, window[0].start - body.part[0].start]
    along = ((np.stack([u, v], axis=1) + corner) / body.step - body.centre) @ body.axis
    same = np.abs(body.off_m(depth_m[window][v, u], along)) < body.radius_m
    return bool(len(v) >= MIN_READINGS and same.mean() >= _RING_SHARE)


def _goes_on(body: _Body, end: int, color: NDArray[np.uint8] | None) -> bool:
    """Return whether a surface as wide and of the same colour goes on beyond an end of a mask."""
    pixels, radius = body.pixels, body.radius_px
    along = end * (pixels - body.centre) @ body.axis
    top = along.max()
    tip, inner = along > top - 2 * radius, (along <= top - 2 * radius) & (along > top - 4 * radius)
    if not inner.any():
        return False
    middle = pixels[tip].mean(axis=0)
    ahead = middle - pixels[inner].mean(axis=0)
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    aside = np.array([-ahead[1], ahead[0]])
    forward, sideways = (pixels - middle) @ ahead, (pixels - middle) @ aside
    core = np.abs(sideways) < 0.3 * radius
    edge = forward[core].max(initial=-np.inf)
    core &= (forward > edge - 3 * radius) & (forward < edge - 0.3 * radius)
    u, v = pixels[core].astype(np.intp).T
    read = body.read[v, u]
    if np.count_nonzero(read) < MIN_READINGS:
        return False
    slope, start_m = np.polyfit(forward[core][read], body.depth_m[v, u][read], 1)
    beyond, across = np.linspace(*_BEYOND_RADII, 5), np.linspace(-0.5, 0.5, 5)
    steps, sides = (grid.ravel() * radius for grid in np.meshgrid(beyond, across))
    steps += edge
    places = middle + np.outer(steps, ahead) + np.outer(sides, aside)
    x, y = np.rint(places).astype(np.intp).T
    height, width = body.mask.shape
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    off_m = np.abs(body.depth_m[y, x] - start_m - slope * steps)
    same = inside & body.read[y, x] & ~body.mask[y, x] & (off_m < _SURFACE_RADII * body.radius_m)
    if same.mean() < _BEYOND_SHARE or color is None:
        return bool(same.mean() >= _BEYOND_SHARE)
    part = color[body.part][:: body.step, :: body.step]
    gap = np.median(part[y, x][same], axis=0) - np.median(part[v, u], axis=0)
    return float(np.abs(gap).max()) < _SAME_COLOR


# Real fruit with correct depth do not exceed these limits; some drawn in heaps do, and most masks
# that are moved across by a radius.
_NEAREST_PERCENT, _NEAR_RADII, _SECTIONS = 20, 1.3, 5
_RADIUS_PX, _SHIFTS, _MOVED_RADII = 6.0, 13, 0.6
_ALIGNED, _BETTER, _LEAST_KNOWN = 1.0, 0.7, 0.3
_BESIDE_SCORES = -1.0, 0.8  # of a mask beside its fruit: more is on it, less is behind others
_WIDER = 0.7  # focal length of a D435's depth, relative to its colour's
_ALIGNED_AS_WIDER, _BETTER_AS_WIDER, _BEST_SCORE = 1.2, 0.8, 2.0


def _fits_better_elsewhere(depth_m: NDArray[np.float32], body: _Body) -> bool:
    """Return whether a mask fits its depth much better moved, or enlarged from a wider camera."""
    layers = _layers(body.depth_m, body)
    if layers is None:
        return False
    score = float(_scores(layers, 0)[0, 0])
    least, most = _BESIDE_SCORES
    if least <= score <= most:
        limit = max(_ALIGNED, score + _BETTER)
        if _is_best(_scores(layers, _SHIFTS), limit, _MOVED_RADII * _RADIUS_PX):
            return True
    limit = max(_ALIGNED_AS_WIDER, score + _BETTER_AS_WIDER)
    if limit > _BEST_SCORE:
        return False
    layers = _layers(_as_wider(depth_m, body), body)
    return layers is not None and _is_best(_scores(layers, _SHIFTS), limit)


def _is_best(scores: NDArray[np.float32], least: float, least_moved: float = 0.0) -> bool:
    """Return whether the best score is high enough, at a place that is moved far enough."""
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    moved = np.abs(np.array(best) - _SHIFTS)
    # A best position at the border of the search may belong to another object.
    return bool(scores[best] >= least and np.hypot(*moved) >= least_moved and moved.max() < _SHIFTS)


def _as_wider(depth_m: NDArray[np.float32], body: _Body) -> NDArray[np.float32]:
    """Return a part of a depth picture, enlarged about the middle as if nobody had aligned it."""
    import cv2

    height, width = depth_m.shape
    v, u = body.part
    scale = _WIDER * body.step
    turn = np.array(
        [
            [scale, 0.0, width / 2 + (u.start - width / 2) * _WIDER],
            [0.0, scale, height / 2 + (v.start - height / 2) * _WIDER],
        ]
    )
    size = body.mask.shape[::-1]
    nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(depth_m, turn, size, flags=nearest), np.float32)


def _layers(depth_m: NDArray[np.float32], body: _Body) -> NDArray[np.float32] | None:
    """Return what is near (1) and far (-1), what is read, the mask and a ring around it, shrunk.

    Near is what lies before 1.3 apparent radii behind what is nearest along the fruit,
    because the distance at the mask may be that of another object. None without a line.
    """
    import cv2

    read = valid_depth(depth_m)
    line = body.line if depth_m is body.depth_m else body.near_line(depth_m, read)
    if line is None:
        return None
    limit_m = (line[0] + line[1] * body.along) * (1 + _NEAR_RADII * body.radius_m / body.distance_m)
    behind = np.where(depth_m < limit_m, np.float32(1), np.float32(-1)) * read
    # Six pixels per radius are enough to find the best position.
    scale = min(1.0, _RADIUS_PX / body.radius_px)
    size = [max(1, round(n * scale)) for n in body.mask.shape[::-1]]
    values, is_read, shape = (
        np.asarray(cv2.resize(np.asarray(part, np.float32), size, interpolation=cv2.INTER_AREA))
        for part in (behind, read, body.mask)
    )
    outer, inner = (np.asarray(cv2.dilate(shape, np.ones((n, n)))) for n in (7, 3))
    ring = np.clip(outer - inner, np.float32(0), np.float32(1))
    return np.stack([values, is_read, shape, ring]).astype(np.float32)


def _scores(layers: NDArray[np.float32], shifts: int) -> NDArray[np.float32]:
    """Return how well a mask fits depth at each shift up to so many pixels.

    The score is the mean inside the mask minus the mean around it, where near readings count +1 and
    far ones -1; it is 2 for a free-standing fruit.
    """
    import cv2

    values, is_read, *weights = layers
    means = []
    for weight in weights:
        sums, counts = (
            np.asarray(cv2.matchTemplate(np.pad(part, shifts), weight, cv2.TM_CCORR))
            for part in (values, is_read)
        )
        least_weight = _LEAST_KNOWN * float(weight.sum())
        means.append(sums / np.maximum(counts, max(least_weight, 1e-3)))
    return np.asarray(means[0] - means[1], np.float32)


_LEVEL_SAMPLES = 10_000
_LEVEL_READINGS, _LEVELS_SHARE = 3, 0.9  # of a level, and on levels; the rest may be mixtures
# Of the distance. Depth in millimetres has 0.8 % at 0.12 m, a Kinect 0.6 % at 2 m, a D435 0.2 %.
_COARSE_STEP = 0.012
_FRUIT_LEVELS, _PICTURE_LEVELS = 3, 4  # needed to tell; drawn pictures of flat things have fewer
_NEAR_M, _PICTURE_STRIDE = 2.0, 4  # where the steps of a picture are looked at
_EIGHT_BITS_M, _MILLIMETRE_M = 0.2555, 0.00099


def has_coarse_steps(
    depth_m: NDArray[np.float32], readings_m: NDArray[np.float32], *, may_be_one: bool = True
) -> bool:
    """Return whether depth has too few values for a round body, as after 8 bits.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres; 0 for no reading.
    readings_m : ndarray of float32, shape (N,)
        Those of the fruit, at least one.
    may_be_one : bool
        Whether one value of most of them counts, where the picture holds several.

    Examples
    --------
    >>> round_body_m = np.linspace(0.48, 0.5, 2000, dtype=np.float32).reshape(20, 100).round(3)
    >>> has_coarse_steps(round_body_m, round_body_m.ravel())
    False
    >>> whole_centimetres = round_body_m.round(2)
    >>> has_coarse_steps(whole_centimetres, whole_centimetres.ravel())
    True
    """
    picture_m = depth_m[::_PICTURE_STRIDE, ::_PICTURE_STRIDE]
    picture_m = picture_m[(picture_m > 0) & (picture_m < _NEAR_M)]
    counts = np.unique(readings_m, return_counts=True)[1]
    if may_be_one and counts.max() >= _ONE_VALUE_SHARE * counts.sum():
        return len(np.unique(picture_m)) > 1
    return _is_coarse(picture_m, readings_m) or _has_eight_bits(depth_m, readings_m)


def _is_coarse(picture_m: NDArray[np.float32], readings_m: NDArray[np.float32]) -> bool:
    """Return whether a fruit's readings are too few values for a round body.

    Where steps are as thick as the fruit, those of the picture tell.
    """
    levels_m, least = _levels(readings_m), _FRUIT_LEVELS
    if 0 < len(levels_m) < least:
        levels_m, least = _levels(picture_m), _PICTURE_LEVELS
    if len(levels_m) < least:
        return False
    return float(np.median(np.diff(levels_m) / levels_m[1:])) > _COARSE_STEP


def _has_eight_bits(depth_m: NDArray[np.float32], readings_m: NDArray[np.float32]) -> bool:
    """Return whether a picture holds 0 to 255 mm, as one of 8 bits that was saved with 16.

    Cameras that read so near store tenths of a millimetre.
    """
    if readings_m.max() > _EIGHT_BITS_M or depth_m.max() > _EIGHT_BITS_M:
        return False
    levels_m = _levels(readings_m)
    return len(levels_m) > 1 and float(np.diff(levels_m).min()) >= _MILLIMETRE_M


def _levels(readings_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the values that nearly all readings have, ascending; empty if there are none."""
    spacing = max(1, readings_m.size // _LEVEL_SAMPLES)
    levels_m, counts = np.unique(readings_m[::spacing], return_counts=True)
    common = counts >= _LEVEL_READINGS
    if counts[common].sum() < _LEVELS_SHARE * counts.sum():
        common[:] = False
    return np.asarray(levels_m[common], np.float32)
