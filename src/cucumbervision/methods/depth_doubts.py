"""Detect depth and outlines that cannot be those of one fruit; pure functions of arrays."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.frames import valid_depth
from cucumbervision.fruit.masks import distances_inside, mask_pixels, mask_window, without_specks
from cucumbervision.methods.flags import Flag
from cucumbervision.tube.evidence import quick_median
from cucumbervision.tube.shape import principal_axis

Mask = NDArray[np.bool_]
Depth = NDArray[np.float32]
Places = NDArray[np.float64]

LEAST_FILL = 0.5
"""Share of a fruit's pixels with depth below which its length is doubtful.

Nearer than its range a camera reads a few pixels of the rim, which are wrong.
"""

MIN_READINGS = 30
"""Number of readings without which depth says nothing."""

_BODY_PX, _SCORE_PX = 10.0, 6.0  # of a radius: more pixels say no more, of a score less
_AXIS_PIXELS, _MARGIN_RADII = 2000, 2.5  # enough for the axis; of the strip around the mask
_NEAREST_M = 0.12  # minimum distance of common depth cameras (D405: 7 cm, D435: 17 cm)
# Ranges of the middle and the flanks: distance from the outline relative to the largest. The flanks
# of a tube lie 0.12 to 0.55 radii behind the middle, 0.26 in the median.
_MIDDLE_FROM, _FLANK_RANGE = 0.75, (0.15, 0.5)
# In apparent radii: how far the middle of a hollow fruit lies behind the flanks at least, and the
# differences within a fruit whose depth is one value and noise at most
_HOLLOW_RADII, _FLAT_RADII = 0.08, 0.04
# Stereo depth of thin fruit between leaves is hollow, too, but their surroundings are not nearer.
_SURROUNDING_RADII = (-1.0, -0.3)
_CLEAR_SHARE, _NOISE_SD = 0.85, 4.0  # of the readings there; standard errors of both medians
# Size of a piece, relative to the mask, and of a part on one side of a waist. A line that joins
# pieces is no part of them.
_LEAST_PIECE, _LEAST_PART, _LINE_RADII = 0.01, 0.1, 0.12
_WAIST_SHARE = 0.72  # of the largest radius: a narrower place between wider parts is a waist
# How far a gap lies behind the surface at its ends, in radii, between pieces and beside a waist;
# share of the readings across it; its least length in radii, and readings beside a waist
_GAP_BEHIND, _NOTCH_BEHIND, _GAP_SHARE, _GAP_RADII, _GAP_READINGS = 1.2, 2.0, 0.8, 0.2, 6
# In radii: the ring that defines the plane; the minimum height of a fruit above it (real ones 1.4
# to 2.5 above a table); the roughness of planes (0.3 for printed paper, at least 0.4 for leaves).
_PLANE_RING_RADII, _LEAST_HEIGHT_RADII, _ROUGHNESS_RADII = (-1.2, -0.15), 0.5, 0.3
_PLANE_STEPS, _PLANE_READINGS = 4, 500
# Size of a piece relative to the rest, and the share of the readings between the two that do not
# lie so many radii in front of both, above which it is another fruit's.
_SMALL_PIECE, _BARE_SHARE, _IN_FRONT_RADII = 0.2, 0.7, 0.3
# Readings in the outline that lie so many radii behind the surface around them, and their share in
# three quarters of the sections: that of a rim of 2 px, within limits; distance from the plane.
_BEHIND_RADII, _IN_PLANE_RADII, _BESIDE_PX, _BESIDE_SHARES = 4.0, 0.3, 2.1, (0.07, 0.25)
# Edge in depth: how far behind what is nearest skin lies at most; how far from the outline it is
# looked for; spread along a side of a sharp edge, of what lies along the sides in so many parts;
# distance from the outline, least and relative to the length, at which the interval is wrong.
_SKIN_RADII, _EDGE_RADII, _EDGE_PX, _PARTS = 1.3, 0.8, 12, 12
_SHARP_PX, _SHARP_SHARE, _LOOSE_PX, _LOOSE_SHARE = 1.0, 0.1, 1.2, 0.008
_NETWORK_PX = (
    3.0  # the same of outlines by networks: intervals are learnt on such as are 1 to 2 off
)
_ONE_VALUE_SHARE = 0.6  # real skin has one value on at most 0.23 of its pixels
# Width of a stem and of the shoulder half a radius behind it, relative to the fruit's; a tip tapers
# slowly. Minimum length of a stem with such a shoulder, and of one without, and how far what is
# beside it lies behind the fruit, in radii.
_STEM_WIDTH, _SHOULDER_WIDTH, _STEM_RADII, _TAPER_RADII, _CLEAR_RADII = 0.35, 0.86, 0.4, 1.0, 0.8
# Surface that goes on beyond an end.
_BEYOND_RADII, _BLUR_PX = np.array([0.2, 0.7]), np.array([5.0, 9.0])
_BEYOND_SHARE, _SURFACE_RADII, _SAME_COLOR = 0.75, 0.5, 45.0


def depth_doubts(
    depth_m: NDArray[np.float32],
    mask: NDArray[np.bool_],
    focal_px: float,
    color: NDArray[np.uint8] | None = None,
    *,
    by_network: bool = False,
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
        The image: what goes on beyond an end has the fruit's colour.
    by_network : bool
        Whether a network drew the mask, which is then less exact.

    Returns
    -------
    tuple of Flag
        'depth-too-near': the fruit is nearer than the minimum distance of any camera. 'depth-
        sparse': less than half of its pixels have a reading. 'depth-hollow': its middle lies behind
        its flanks, and the fruit behind its surroundings, as in inverted depth. 'depth-gap': the
        mask has several parts, and the background between them is clearly farther away, so that
        they are different fruit. 'depth-unaligned': the fruit does not stand out from the plane
        around it, the mask reaches beyond a sharp edge in depth on both sides, or it fits the near
        depth much better at another position. 'depth-coarse': its readings differ in steps
        of over 1.2 % of the distance, or are one value with or without noise, or the picture holds
        whole millimetres up to 255; not of a fruit that is too near. 'outline-stem': an end of the
        mask is a third as wide as the fruit. 'outline-short': the surface goes on beyond an end or
        beyond both sides.

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
    if np.count_nonzero(mask) < 2:
        return ()
    body = _Body(depth_m, mask, focal_px)
    is_sparse = body.readings_m.size < LEAST_FILL * np.count_nonzero(body.mask)
    if body.readings_m.size < MIN_READINGS:
        return (Flag.DEPTH_SPARSE,) if is_sparse else ()
    is_too_near = body.distance_m < _NEAREST_M
    offset_px = _outline_offset_px(depth_m, body)
    least_px = _NETWORK_PX if by_network else _LOOSE_PX
    is_loose = abs(offset_px) > max(least_px, _LOOSE_SHARE * body.scale * np.ptp(body.ends))
    is_short = is_loose and offset_px > 0
    is_elsewhere = not is_short and (
        is_loose
        or _lies_in_plane(body)
        or _lies_behind(body)
        or _fits_better_elsewhere(depth_m, body)
    )
    is_coarse = has_coarse_steps(depth_m, body.readings_m, may_be_one=not is_sparse)
    is_coarse |= not is_elsewhere and _has_one_depth(body)
    doubts = {
        Flag.DEPTH_TOO_NEAR: is_too_near,
        Flag.DEPTH_SPARSE: is_sparse,
        Flag.DEPTH_HOLLOW: _is_hollow(body),
        Flag.DEPTH_GAP: _has_gap(body),
        Flag.DEPTH_UNALIGNED: is_elsewhere,
        Flag.DEPTH_COARSE: is_coarse and not is_too_near,
    }
    # Wrong depth says nothing of an outline.
    doubts[Flag.OUTLINE_STEM] = not any(doubts.values()) and _has_stem(body)
    doubts[Flag.OUTLINE_SHORT] = not any(doubts.values()) and (
        is_short or any(_goes_on(body, end, color) for end in (-1, 1))
    )
    return tuple(flag for flag, holds in doubts.items() if holds)


class _Body:
    """A fruit that lies along the columns of a strip cut out of the image.

    Its radius has about `_BODY_PX` pixels at most, and distances are in pixels of the strip, of
    `scale` pixels of the image each. `turn` leads from the strip to the image; `off_m` is how
    far readings lie behind `line`, NaN without one. `outline` is the mask with the strip's columns
    and the rows of the image, to which `outline_turn` leads.
    """

    def __init__(self, depth_m: Depth, mask: Mask, focal_px: float) -> None:
        self.turn, size = _strip(mask)
        self.mask = without_specks(_warped(mask.view(np.uint8), self.turn, size) > 0, _LEAST_PIECE)
        self.depth_m: Depth = _warped(depth_m, self.turn, size)
        self.read = valid_depth(self.depth_m)
        self.readings_m = self.depth_m[self.mask & (self.depth_m > 0)]
        self.distance_m = float(quick_median(self.readings_m)) if len(self.readings_m) else np.nan
        self.scale = float(np.hypot(*self.turn[:, 0]))
        # The outline is nearer than the first pixel of the strip beyond it.
        nearer_px = np.float32(0.5 - 0.5 / self.scale)
        inside_px, outside_px = (distances_inside(m) - nearer_px for m in (self.mask, ~self.mask))
        self.radius_px = float(inside_px.max())
        self.depth_radii = np.where(self.mask, inside_px, -outside_px) / self.radius_px
        self.radius_m = self.radius_px * self.scale * self.distance_m / focal_px
        columns = np.flatnonzero(self.mask.any(axis=0))
        self.ends = (int(columns[0]), int(columns[-1])) if len(columns) else (0, 0)
        self.line = self.near_line(self.depth_m, self.read)
        self.off_m = self.behind_line(self.depth_m)
        self.outline_turn = self.turn / [1.0, self.scale, 1.0]
        rows = int(np.ceil(self.scale * size[1]))
        self.outline = _warped(mask.view(np.uint8), self.outline_turn, (size[0], rows)) > 0

    def behind_line(self, depth_m: Depth) -> Places:
        """Return how far depth, with the columns of the strip, lies behind the line."""
        start_m, slope = self.line or (np.nan, 0.0)
        return np.asarray(depth_m - start_m - slope * np.arange(depth_m.shape[1]))

    def between(self, least: float, most: float = np.inf) -> Mask:
        """Return what is read from so many radii inside the outline; negative outside it."""
        return self.read & (self.depth_radii >= least) & (self.depth_radii <= most)

    def sections(self, count: int) -> list[slice]:
        """Return equal ranges of columns along the mask."""
        bounds = np.linspace(self.ends[0], self.ends[1] + 1, count + 1).astype(int)
        return [slice(a, b) for a, b in pairwise(bounds)]

    def has_all_along(self, wrong: Mask) -> bool:
        """Return whether a share of the mask, nearly all along, is wrong."""
        read = self.mask & self.read
        wrong = wrong & read
        shares = [
            int(wrong[:, part].sum()) / max(int(read[:, part].sum()), 1)
            for part in self.sections(_PARTS)
        ]
        limit = np.clip(_BESIDE_PX / (self.radius_px * self.scale), *_BESIDE_SHARES)
        return bool(np.quantile(shares, 0.25) >= limit)

    def near_line(self, depth_m: Depth, read: Mask) -> tuple[float, float] | None:
        """Return the depth of what is nearest along the fruit: at column 0, and its slope.

        A fruit that points at the camera is farther away at one end by more than its radius. None
        with too few readings.
        """
        near = read & (self.depth_radii >= -1)
        if np.count_nonzero(near) < MIN_READINGS:
            return None
        lines = [
            ((part.start + part.stop - 1) / 2, _nearest_m(readings))
            for part in self.sections(_SECTIONS)
            if len(readings := depth_m[:, part][near[:, part]]) >= MIN_READINGS // 2
        ]
        if len(lines) < 3:
            return _nearest_m(depth_m[near]), 0.0
        # Theil and Sen: what hides one section does not turn the line.
        t, near_m = np.array(lines).T
        i, j = np.triu_indices(len(t), 1)
        slope = float(np.median((near_m[j] - near_m[i]) / (t[j] - t[i])))
        return float(np.median(near_m - slope * t)), slope

    def pixels(self, places: Places) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return rows and columns of the pixels at places (u, v), or nearest to them."""
        height, width = self.mask.shape
        u, v = np.clip(np.rint(places), 0, (width - 1, height - 1)).astype(np.intp).T
        return v, u

    def surface_m(self, place: Places) -> float:
        """Return the fruit's depth within a radius of a place; NaN without a reading."""
        reach = round(self.radius_px)
        u, v = place.astype(int)
        near = slice(max(v - reach, 0), v + reach + 1), slice(max(u - reach, 0), u + reach + 1)
        readings = self.depth_m[near][self.mask[near] & self.read[near]]
        return float(quick_median(readings)) if len(readings) else np.nan


def _nearest_m(readings_m: Depth) -> float:
    rank = int(_NEAREST_SHARE * len(readings_m))
    return float(np.partition(readings_m, rank)[rank])


def _strip(mask: Mask) -> tuple[Places, tuple[int, int]]:
    """Return the strip along a mask of at least two pixels: its turn, its width and height."""
    y, x = mask_window(mask) or (slice(0, 0), slice(0, 0))
    step = max(1, int(np.sqrt(np.count_nonzero(mask[y, x]) / _AXIS_PIXELS)))
    pixels = step * mask_pixels(mask[y, x][::step, ::step])
    centre, (along, down) = principal_axis(pixels)
    axes = np.array([[along, -down], [down, along]])
    places = (pixels - centre) @ axes
    low, high = places.min(axis=0), places.max(axis=0)
    about_px = step * step * len(pixels) / (2 * (high[0] - low[0] + step))
    scale, margin = max(1.0, about_px / _BODY_PX), _MARGIN_RADII * about_px + 3 + step
    corner = centre + (x.start, y.start) + axes @ (low - margin)
    width, height = np.ceil((high - low + 2 * margin) / scale).astype(int)
    return np.column_stack([scale * axes, corner]), (int(width), int(height))


def _warped(picture: NDArray[Any], turn: Places, size: tuple[int, int]) -> NDArray[Any]:
    """Return a strip of a picture by the nearest pixels, 0 beyond the picture."""
    nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(picture, turn, size, flags=nearest))


def _is_hollow(body: _Body) -> bool:
    """Return whether a mask's middle lies behind its flanks, and its surroundings are nearer."""
    middle = body.depth_m[body.between(_MIDDLE_FROM)]
    flank = body.depth_m[body.between(*_FLANK_RANGE)]
    if min(middle.size, flank.size) < MIN_READINGS:
        return False
    depth_behind_m = float(quick_median(middle) - quick_median(flank))
    # Standard errors of medians, from the median absolute deviation
    error_m = np.hypot(*(1.2533 * _robust_sd(a) / np.sqrt(a.size) for a in (middle, flank)))
    if depth_behind_m <= max(_HOLLOW_RADII * body.radius_m, _NOISE_SD * error_m):
        return False
    around = body.depth_m[body.between(*_SURROUNDING_RADII)]
    nearer = around < body.distance_m
    return around.size >= MIN_READINGS and float(nearer.mean()) >= _CLEAR_SHARE


def _has_gap(body: _Body) -> bool:
    """Return whether what lies between a mask's parts is clearly farther away.

    Parts are connected components, or the wide parts beside a waist (two fruit end to end).
    """
    pieces = _parts(body.depth_radii > _LINE_RADII, _LEAST_PIECE)
    if any(_is_open(body, piece, rest) for piece, rest in pieces):
        return True
    worn = _parts(body.depth_radii >= _WAIST_SHARE, _LEAST_PART)
    return any(_is_notched(body, *_nearest(part, rest)) for part, rest in worn)


def _parts(core: Mask, least: float) -> list[tuple[Mask, Mask]]:
    """Return each large part of a mask but the largest, and all others."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(core.astype(np.uint8))
    areas = stats[1:count, cv2.CC_STAT_AREA]
    large = [1 + part for part in areas.argsort() if areas[part] > least * areas.sum()]
    every = np.isin(labels, large)
    return [(labels == part, every & (labels != part)) for part in large[:-1]]


def _nearest(part: Mask, rest: Mask) -> tuple[Places, Places]:
    """Return the places (u, v) of a part and of the rest that are nearest to each other."""
    places = [
        np.unravel_index(np.where(at, distances_inside(~to), np.inf).argmin(), at.shape)[::-1]
        for at, to in ((part, rest), (rest, part))
    ]
    return np.array(places[0], np.float64), np.array(places[1], np.float64)


def _across(
    body: _Body, first: Places, last: Places, offsets: Places, within: Mask | Literal[True] = True
) -> tuple[Mask, Places]:
    """Return what is read on lines beside that between two places, and how far it lies behind.

    One row for each pixel of the line, and one column for each offset from it; of what is off the
    mask.
    """
    way = last - first
    length_px = max(float(np.hypot(*way)), 1.0)
    share, aside = np.arange(1.0, length_px) / length_px, np.array([-way[1], way[0]]) / length_px
    places = first + share[:, None, None] * way + offsets[None, :, None] * aside
    v, u = (axis.T for axis in body.pixels(places))
    read = (body.read & within & ~body.mask)[v, u]
    surface_m = (1 - share) * body.surface_m(first) + share * body.surface_m(last)
    behind_m = body.depth_m[v, u] - surface_m[:, None]
    return read, np.where(read, behind_m / body.radius_m, 0.0)


def _is_open(body: _Body, piece: Mask, rest: Mask) -> bool:
    """Return whether the way from a piece to the rest leads over something clearly farther away.

    From a small piece, as that of a neighbour, also over anything that is not nearer: what parts
    the outline of one fruit lies in front of it.
    """
    offsets = np.linspace(-0.3, 0.3, 5) * body.radius_px
    read, behind = _across(body, *_nearest(piece, rest), offsets)
    is_bare = (behind[read] > -_IN_FRONT_RADII).sum() > _BARE_SHARE * max(read.sum(), _GAP_READINGS)
    if is_bare and piece.sum() < _SMALL_PIECE * rest.sum():
        return True
    counts = read.sum(axis=1)
    steps = (counts > 0) & ((behind > _GAP_BEHIND).sum(axis=1) >= _GAP_SHARE * counts)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], steps, [0]])))
    return bool(max(ends[1::2] - ends[::2], default=0) >= max(2.0, _GAP_RADII * body.radius_px))


def _is_notched(body: _Body, first: Places, last: Places) -> bool:
    """Return whether a waist has something clearly farther away on both sides.

    A leaf or tendril notches one side.
    """
    v, u = np.nonzero(body.mask)
    near = np.hypot(u - (first[0] + last[0]) / 2, v - (first[1] + last[1]) / 2)
    beside = np.stack([u, v], axis=1)[near < 2.0 * body.radius_px].astype(np.int32)
    if not len(beside):
        return False
    hull = np.zeros(body.mask.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(beside), 1)
    sides = np.arange(1.0, 1.5 * body.radius_px)
    for offsets in (sides, -sides):
        read, behind = _across(body, first, last, offsets, hull > 0)
        if read.sum() < max(
            _GAP_READINGS, (behind <= _NOTCH_BEHIND)[read].sum() / (1 - _GAP_SHARE)
        ):
            return False
    return True


def _lies_in_plane(body: _Body) -> bool:
    """Return whether a mask lies in the plane around it, wholly or along its rim."""
    around, middle = body.between(*_PLANE_RING_RADII), body.between(0.5)
    if min(np.count_nonzero(around), np.count_nonzero(middle)) < MIN_READINGS:
        return False
    v, u = np.nonzero(around)
    v, u = (axis[:: 1 + len(v) // _PLANE_READINGS] for axis in (v, u))
    places, z_m = np.stack([u, v, np.ones(len(u))], axis=1), body.depth_m[v, u]
    fits = np.ones(len(z_m), bool)
    for _ in range(_PLANE_STEPS):
        known = places[fits]
        plane = np.linalg.solve(known.T @ known, known.T @ z_m[fits])
        gap_m = z_m - places @ plane
        around_sd_m = _robust_sd(gap_m[fits])
        fits = np.abs(gap_m - quick_median(gap_m[fits])) <= 3.0 * around_sd_m + 1e-4
    v, u = np.ogrid[: body.mask.shape[0], : body.mask.shape[1]]
    ahead_m = np.abs(body.depth_m - plane[0] * u - plane[1] * v - plane[2])
    if max(around_sd_m, _robust_sd(ahead_m[middle])) >= _ROUGHNESS_RADII * body.radius_m:
        return False
    is_flat = quick_median(ahead_m[middle]) < _LEAST_HEIGHT_RADII * body.radius_m
    return bool(is_flat) or body.has_all_along(ahead_m < _IN_PLANE_RADII * body.radius_m)


def _robust_sd(values: NDArray[np.floating[Any]]) -> float:
    return 1.4826 * float(quick_median(np.abs(values - quick_median(values))))


def _lies_behind(body: _Body) -> bool:
    """Return whether a mask lies partly on what is far behind, nearly all along the fruit."""
    if body.line is None:
        return False
    read = body.mask & body.read
    # A fruit that points at the camera is farther away at one end.
    surface_m = cv2.medianBlur(np.where(read, body.off_m, 1e3).astype(np.float32), 3)
    side_px = 2 * round(body.radius_px) + 1
    near_m = np.asarray(cv2.erode(surface_m, np.ones((side_px, side_px), np.uint8)))
    return body.has_all_along(body.off_m > near_m + _BEHIND_RADII * body.radius_m)


def _outline_offset_px(depth_m: Depth, body: _Body) -> float:
    """Return how far an outline lies within its fruit's edge in depth; negative beyond it.

    In pixels of the image, along both long sides. 0 where depth shows no sharp edge along them, as
    that of a stereo camera, which is a few pixels off its fruit.
    """
    if body.line is None:
        return 0.0
    outline = body.outline
    strip_m = _warped(depth_m, body.outline_turn, outline.shape[::-1])
    skin = valid_depth(strip_m) & (body.behind_line(strip_m) < _SKIN_RADII * body.radius_m)
    background = valid_depth(strip_m) & ~skin
    columns = np.flatnonzero(outline.any(axis=0))
    columns = columns[len(columns) // 6 : -len(columns) // 6]
    steps = np.arange(max(_EDGE_PX, round(_EDGE_RADII * body.radius_px * body.scale)))[:, None]
    sides = []
    for step in (1, -1):
        first = outline[::step, columns].argmax(axis=0)
        outer = np.maximum(first - 1 - steps, 0), columns
        inner = np.minimum(first + steps, len(outline) - 1), columns
        skin_px, gap = skin[::step][outer], background[::step]
        offset_px = skin_px.sum(axis=0) - gap[inner].sum(axis=0)
        # Beyond its edge there is something else.
        ends = ~skin_px[3 * len(steps) // 4 :].any(axis=0) & gap[outer].any(axis=0)
        parts = zip(np.array_split(offset_px, _PARTS), np.array_split(ends, _PARTS), strict=True)
        means = [part[has_end].mean() for part, has_end in parts if has_end.any()]
        if len(means) <= _PARTS // 2:
            return 0.0
        low, median, high = np.quantile(means, [0.25, 0.5, 0.75])
        sides.append(median if high - low <= _SHARP_PX + _SHARP_SHARE * abs(median) else 0.0)
    nearest = float(min(sides, key=abs))
    return nearest if sides[0] * sides[1] > 0 else 0.0


def _has_one_depth(body: _Body) -> bool:
    """Return whether a fruit's depth is one value with noise, without slope or curvature."""
    rim, middle = body.between(*_FLANK_RANGE), body.between(_FLANK_RANGE[1])
    depths = [body.depth_m[:, part][middle[:, part]] for part in body.sections(_PARTS)]
    # Means: medians have the steps of the readings.
    means_m = [depth_m.mean() for depth_m in depths if len(depth_m) >= MIN_READINGS // 2]
    has_background = bool((body.read & ~body.mask).any())
    if len(means_m) <= _PARTS // 2 or not (rim.any() and has_background):
        return False
    flank_m = abs(body.depth_m[rim].mean() - body.depth_m[middle].mean())
    return float(max(np.std(means_m), flank_m)) < _FLAT_RADII * body.radius_m


def _has_stem(body: _Body) -> bool:
    """Return whether an end of a mask is much narrower than the fruit, before what is behind."""
    first, last = body.ends
    widths = body.outline.sum(axis=0) / (2.0 * body.radius_px * body.scale)
    wide = np.flatnonzero(widths >= _STEM_WIDTH)
    if not len(wide):
        return False
    # A leaf that hides most of the width is nearer than the fruit.
    beside = body.between(-1, -1 / body.radius_px)
    clear, half = body.off_m > _CLEAR_RADII * body.radius_m, round(body.radius_px / 2)
    for narrow, shoulder in (
        (slice(first, wide[0]), min(wide[0] + half, last)),
        (slice(wide[-1] + 1, last + 1), max(wide[-1] - half, first)),
    ):
        is_abrupt = widths[shoulder] >= _SHOULDER_WIDTH
        least_px = (_STEM_RADII if is_abrupt else _TAPER_RADII) * body.radius_px
        clear_there = clear[:, narrow][beside[:, narrow]]
        is_long = narrow.stop - narrow.start >= least_px and len(clear_there) >= MIN_READINGS // 2
        if is_long and clear_there.mean() >= _CLEAR_SHARE:
            return True
    return False


def _goes_on(body: _Body, end: int, color: NDArray[np.uint8] | None) -> bool:
    """Return whether a surface as wide and of the same colour goes on beyond an end of a mask."""
    radius, tip = body.radius_px, body.ends[0] if end < 0 else body.ends[1]
    rows, columns = np.nonzero(body.mask)
    inward = end * (tip - columns)
    tail = inward < 4 * radius
    if np.ptp(inward[tail]) < radius:
        return False
    slope, middle = np.polyfit(inward[tail], rows[tail], 1)
    core = tail & (np.abs(rows - middle - slope * inward) < 0.3 * radius)
    if not core.any():
        return False
    edge = inward[core].min()
    core &= (inward > edge + 0.3 * radius) & (inward < edge + 2 * radius)
    v, u = rows[core], columns[core]
    read = body.read[v, u]
    if np.count_nonzero(read) < MIN_READINGS:
        return False
    rise, start_m = np.polyfit(inward[core][read], body.depth_m[v, u][read], 1)
    # Beyond the blur of the camera's edges
    nearest, farthest = np.maximum(_BEYOND_RADII * radius, _BLUR_PX / body.scale)
    steps, sides = np.meshgrid(np.linspace(nearest, farthest, 5) - edge, np.linspace(-0.5, 0.5, 5))
    places = np.stack([tip + end * steps, middle - slope * steps + sides * radius], axis=-1)
    y, x = body.pixels(places.reshape(-1, 2))
    off_m = np.abs(body.depth_m[y, x] - start_m + rise * steps.ravel())
    same = body.read[y, x] & ~body.mask[y, x] & (off_m < _SURFACE_RADII * body.radius_m)
    if color is not None and same.mean() >= _BEYOND_SHARE:
        strip = _warped(color, body.turn, body.mask.shape[::-1]).astype(np.int16)
        same &= np.abs(strip[y, x] - np.median(strip[v, u], axis=0)).max(axis=1) < _SAME_COLOR
    return bool(same.mean() >= _BEYOND_SHARE)


# Real fruit with correct depth do not exceed these limits; some drawn in heaps do, and most masks
# that are moved across by a radius.
_NEAREST_SHARE, _NEAR_RADII, _SECTIONS = 0.2, 1.3, 5
_SHIFTS, _MOVED_RADII = 13, 0.6
_ALIGNED, _BETTER, _LEAST_KNOWN = 1.0, 0.8, 0.3
_BESIDE_SCORES = -1.0, 0.8  # of a mask beside its fruit: more is on it, less is behind others
_WIDER = 0.7  # focal length of a D435's depth, relative to its colour's
_ALIGNED_AS_WIDER, _BETTER_AS_WIDER, _BEST_SCORE = 1.2, 0.9, 2.0


def _fits_better_elsewhere(depth_m: Depth, body: _Body) -> bool:
    """Return whether a mask fits its depth much better moved, or enlarged from a wider camera."""
    layers = _layers(body.depth_m, body)
    if layers is None:
        return False
    score = float(_scores(layers, 0)[0, 0])
    least, most = _BESIDE_SCORES
    if least <= score <= most:
        limit = max(_ALIGNED, score + _BETTER)
        if _is_best(_scores(layers, _SHIFTS), limit, _MOVED_RADII * _SCORE_PX):
            return True
    limit = max(_ALIGNED_AS_WIDER, score + _BETTER_AS_WIDER)
    if limit > _BEST_SCORE:
        return False
    # Enlarged about the picture's middle, as if nobody had aligned it
    middle = np.array(depth_m.shape[::-1]) / 2
    turn = _WIDER * body.turn
    turn[:, 2] += (1 - _WIDER) * middle
    layers = _layers(_warped(depth_m, turn, body.mask.shape[::-1]), body)
    return layers is not None and _is_best(_scores(layers, _SHIFTS), limit)


def _is_best(scores: Depth, least: float, least_moved: float = 0.0) -> bool:
    """Return whether the best score is high enough, at a place that is moved far enough."""
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    moved = np.abs(np.array(best) - _SHIFTS)
    # A best position at the border of the search may belong to another object.
    return bool(scores[best] >= least and np.hypot(*moved) >= least_moved and moved.max() < _SHIFTS)


def _layers(depth_m: Depth, body: _Body) -> Depth | None:
    """Return what is near (1) and far (-1), what is read, the mask and a ring around it, shrunk.

    Near is what lies before 1.3 apparent radii behind what is nearest along the fruit,
    because the distance at the mask may be that of another object. None without a line.
    """
    is_own = depth_m is body.depth_m
    read = body.read if is_own else valid_depth(depth_m)
    line = body.line if is_own else body.near_line(depth_m, read)
    if line is None:
        return None
    height, width = body.mask.shape
    limit_m = line[0] + line[1] * np.arange(width, dtype=np.float32)
    limit_m *= 1 + _NEAR_RADII * body.radius_m / body.distance_m
    behind = np.where(depth_m < limit_m, np.float32(1), np.float32(-1)) * read
    scale = min(1.0, _SCORE_PX / body.radius_px)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    values, is_read, shape = (
        np.asarray(cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_AREA))
        for part in (behind, read, body.mask)
    )
    outer, inner = (np.asarray(cv2.dilate(shape, np.ones((n, n)))) for n in (7, 3))
    ring = np.clip(outer - inner, np.float32(0), np.float32(1))
    return np.stack([values, is_read, shape, ring]).astype(np.float32)


def _scores(layers: Depth, shifts: int) -> Depth:
    """Return how well a mask fits depth at each shift up to so many pixels.

    The score is the mean inside the mask minus the mean around it, where near readings count +1 and
    far ones -1; it is 2 for a free-standing fruit.
    """
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


_LEVEL_READINGS, _LEVELS_SHARE = 3, 0.9  # of a level, and on levels; the rest may be mixtures
# Of the distance. Depth in millimetres has 0.8 % at 0.12 m, a Kinect 0.6 % at 2 m, a D435 0.2 %.
_COARSE_STEP = 0.012
_FRUIT_LEVELS, _PICTURE_LEVELS = 3, 4  # needed to tell; drawn pictures of flat things have fewer
_NEAR_M, _PICTURE_STRIDE = 2.0, 4  # where the steps of a picture are looked at
_EIGHT_BITS_M, _MILLIMETRE_M = 0.2555, 0.00099


def has_coarse_steps(depth_m: Depth, readings_m: Depth, *, may_be_one: bool = True) -> bool:
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
    levels_m = _levels(readings_m)
    # 0 to 255 mm, as a picture of 8 bits that was saved with 16; cameras that read so near store
    # tenths of a millimetre.
    steps_m = np.diff(levels_m)
    is_fine = not len(steps_m) or steps_m.min() < _MILLIMETRE_M
    if not is_fine and max(readings_m.max(), depth_m.max()) <= _EIGHT_BITS_M:
        return True
    least = _FRUIT_LEVELS
    if 0 < len(levels_m) < least:  # steps as thick as the fruit: those of the picture tell
        levels_m, least = _levels(picture_m), _PICTURE_LEVELS
    return len(levels_m) >= least and (
        float(np.median(np.diff(levels_m) / levels_m[1:])) > _COARSE_STEP
    )


def _levels(readings_m: Depth) -> Depth:
    """Return the values that nearly all readings have, ascending; empty if there are none."""
    levels_m, counts = np.unique(readings_m, return_counts=True)
    common = counts >= _LEVEL_READINGS
    if counts[common].sum() < _LEVELS_SHARE * counts.sum():
        common[:] = False
    return np.asarray(levels_m[common], np.float32)
