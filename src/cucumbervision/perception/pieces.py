"""Join the parts of a fruit on both sides of a leaf or string into one instance.

Two parts are one fruit if one axis runs through both, their thickness is equal at the gap, and the
gap is as wide at its sides as in the middle; between two round ends it widens towards the sides.
With depth, the object in the gap must be nearer than the fruit (a thin string: not farther);
without depth, the parts must have the same colour. Two fruit with both ends behind one leaf look
like one, so gaps of more than 2.5 diameters (2 without depth) and totals of more than 12 are not
joined.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.perception.instances import visible_mask
from cucumbervision.perception.masks import mask_pixels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.perception.instances import Instance

# Lengths are in diameters of the thinner part.
_NARROWEST_GAP = 0.08  # a string's width; touching masks are two fruit, one in front of the other
_LONGEST_GAP, _LONGEST_GAP_UNSEEN = 2.5, 2.0  # with depth, and without
_LONGEST_WHOLE = 12.0
_SHORTEST_PART = 0.3
_NEAR = 2.0  # length of a part, from the gap, that gives its axis and diameter
_SIDES = 0.4  # how far from the axis the gap is examined
_BESIDE, _INNER = 0.75, 0.35  # of that: which lines count as sides, and which as middle
_OPENING = 0.15  # allowed extra width of the gap at its sides; between two round ends it is 0.27
_OFFSET = 0.3  # between the two axes, in the middle of the gap
_THIN_GAP = 0.35  # a string's: too thin for a depth camera to see it nearer
_EQUAL_GIRTH = 0.7  # thinner over thicker
_TURN_DEG = 30.0  # between the two axes
_AXIS_SPAN = 0.6  # how long a part must be before it has an axis of its own
_NEARER, _NEARER_SHARE = 0.008, 0.6  # of the distance, and of the readings in the gap
_FARTHER, _FARTHER_SHARE = 0.02, 0.2
_DEPTH_STEP = 0.03  # of the distance, between both parts' predicted depths of the gap
_SAME_COLOR = 18.0  # between the parts' medians, in CIE Lab


def join_across(
    instances: Sequence[Instance],
    color_rgb: NDArray[np.uint8],
    depth_m: NDArray[np.float32] | None = None,
) -> tuple[Instance, ...]:
    """Join the parts of fruit that an object in front splits.

    Parameters
    ----------
    instances : sequence of Instance
        With masks; those without join nothing.
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres, aligned to colour; 0 where there is no reading.

    Returns
    -------
    tuple of Instance
        Best first. A joined instance has the common box and mask, the best confidence and no
        keypoints.

    Examples
    --------
    >>> from cucumbervision.perception.instances import Instance
    >>> from cucumbervision.perception.masks import box_of_mask
    >>> left, right = np.zeros((40, 200), bool), np.zeros((40, 200), bool)
    >>> left[10:30, 10:90] = right[10:30, 96:180] = True
    >>> parts = [Instance(box_of_mask(m), detector_mask=m) for m in (left, right)]
    >>> [one.box.tolist() for one in join_across(parts, np.zeros((40, 200, 3), np.uint8))]
    [[9.5, 9.5, 179.5, 29.5]]
    """
    left = [(one, _part_of(one)) for one in instances]
    while (pair := _best_pair([part for _, part in left], color_rgb, depth_m)) is not None:
        joined = _joined(left[pair[0]][0], left[pair[1]][0])
        rest = [both for k, both in enumerate(left) if k not in pair]
        left = [*rest, (joined, _part_of(joined))]
    return tuple(sorted((one for one, _ in left), key=lambda one: -one.confidence))


def _part_of(instance: Instance) -> _Part | None:
    mask = visible_mask(instance)
    return None if mask is None else _Part.of(mask)


@dataclass(frozen=True, eq=False)
class _Part:
    """A mask's pixels, with their middle, direction, length and mean thickness."""

    pixels: NDArray[np.float64]
    centre: NDArray[np.float64]
    long_px: float
    girth_px: float

    @classmethod
    def of(cls, mask: NDArray[np.bool_]) -> _Part | None:
        pixels = mask_pixels(mask)
        if len(pixels) < 20:
            return None
        centre = pixels.mean(axis=0)
        axis = np.linalg.eigh(np.cov((pixels - centre).T))[1][:, 1]
        along = (pixels - centre) @ axis
        long_px = float(np.ptp(along)) + 1
        counts = np.bincount((along - along.min()).astype(int))
        # Of the sections the thicker half: ends and torn edges are thin.
        return cls(pixels, centre, long_px, float(np.quantile(counts[counts > 0], 0.75)))


@dataclass(frozen=True, eq=False)
class _Facing:
    """Two parts in a common frame: s along the line through both, t across it, pixels.

    Parameters
    ----------
    origin, along, across : ndarray of float64, shape (2,)
        The frame.
    girth_px : float
        The thinner part's thickness beside the gap.
    ratio : float
        Thinner over thicker.
    gap_px : float
        Median width of the gap along the lines that cross it.
    opening_px : float
        How much wider it is at its sides than in the middle.
    offset_px : float
        Distance between both axes in its middle.
    turn_deg : float
        Angle between both axes; 0 where one has none of its own.
    whole_px : float
        From the one's far end to the other's.
    edges : ndarray of float64, shape (K, 3)
        t of each line, and where it leaves the one part and enters the other.
    near : pair of ndarray of float64, shape (N, 2)
        s, t of each part's pixels near the gap.
    """

    origin: NDArray[np.float64]
    along: NDArray[np.float64]
    across: NDArray[np.float64]
    girth_px: float
    ratio: float
    gap_px: float
    opening_px: float
    offset_px: float
    turn_deg: float
    whole_px: float
    edges: NDArray[np.float64]
    near: tuple[NDArray[np.float64], NDArray[np.float64]]

    @property
    def fits(self) -> bool:
        """Whether shape and position fit one fruit."""
        girth = self.girth_px
        return (
            self.ratio >= _EQUAL_GIRTH
            and _NARROWEST_GAP * girth <= self.gap_px <= _LONGEST_GAP * girth
            and self.opening_px <= _OPENING * girth
            and self.offset_px <= _OFFSET * girth
            and self.turn_deg <= _TURN_DEG
            and self.whole_px <= _LONGEST_WHOLE * girth
        )

    def pixels(self, s: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return the columns and rows of points of the frame, shape (N, 2)."""
        points = self.origin + s[:, None] * self.along + t[:, None] * self.across
        return np.rint(points).astype(np.intp)

    def gap_pixels(self) -> NDArray[np.intp]:
        """Return the pixels between the two parts, shape (N, 2)."""
        lines = []
        for t, leaves, enters in self.edges:
            s = np.arange(np.floor(leaves) + 2, enters - 1)
            lines.append(self.pixels(s, np.full(len(s), t)))
        return np.unique(np.concatenate(lines), axis=0) if lines else np.empty((0, 2), np.intp)


def _best_pair(
    parts: Sequence[_Part | None],
    color_rgb: NDArray[np.uint8],
    depth_m: NDArray[np.float32] | None,
) -> tuple[int, int] | None:
    """Return which two parts are one fruit, those with the narrowest gap first."""
    best, narrowest = None, np.inf
    for j, b in enumerate(parts):
        for i, a in enumerate(parts[:j]):
            if a is None or b is None:
                continue
            facing = _facing(a, b)
            if facing is None or not facing.fits or facing.gap_px >= narrowest:
                continue
            if _something_in_front(facing, color_rgb, depth_m):
                best, narrowest = (i, j), facing.gap_px
    return best


def _facing(a: _Part, b: _Part) -> _Facing | None:
    """Return the relative position of two parts; None if they are clearly separate."""
    thin, thick = sorted((a.girth_px, b.girth_px))
    far = float(np.linalg.norm(b.centre - a.centre))
    reach = (a.long_px + b.long_px) / 2 + _LONGEST_GAP * thick
    if far < thin / 2 or far > 1.2 * reach or thin < _EQUAL_GIRTH**2 * thick:
        return None
    along, near_a, near_b = _near_the_gap(a, b)
    across = np.array([-along[1], along[0]])
    origin = (near_a.mean(axis=0) + near_b.mean(axis=0)) / 2
    frame = np.column_stack([along, across])
    first, second = (near_a - origin) @ frame, (near_b - origin) @ frame
    fore, aft = _Sections.of(first, -1), _Sections.of(second, 1)
    if fore is None or aft is None:
        return None
    girth = min(fore.girth_px, aft.girth_px)
    if min(fore.long_px, aft.long_px) < _SHORTEST_PART * girth:
        return None
    middle = (fore.middle_px + aft.middle_px) / 2
    edges = _edges(first, second, middle, girth)
    gap = edges[:, 2] - edges[:, 1]
    off = np.abs(edges[:, 0] - middle) / (_SIDES * girth)
    beside, inner = off > _BESIDE, off < _INNER
    slopes = [one.slope for one in (fore, aft) if one.slope is not None]
    if not slopes or not beside.any() or not inner.any():
        return None
    between = float(edges[:, 1:].mean())
    return _Facing(
        origin,
        along,
        across,
        girth,
        girth / max(fore.girth_px, aft.girth_px),
        gap_px=float(np.median(gap)),
        opening_px=float(np.median(gap[beside]) - np.median(gap[inner])),
        offset_px=abs(fore.at(between, aft) - aft.at(between, fore)),
        turn_deg=float(np.ptp(np.rad2deg(np.arctan(slopes)))),
        whole_px=float((b.pixels @ along).max() - (a.pixels @ along).min()),
        edges=edges,
        near=(first, second),
    )


def _near_the_gap(
    a: _Part, b: _Part
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the direction from one part to the other, and the pixels of both beside the gap.

    Only pixels near the gap count, since a bent fruit's parts point past each other's centres.
    """
    apart, near_a, near_b = b.centre - a.centre, a.pixels, b.pixels
    for _ in range(2):
        along = apart / max(float(np.linalg.norm(apart)), 1e-9)
        at_a, at_b = a.pixels @ along, b.pixels @ along
        near_a = a.pixels[at_a > at_a.max() - _NEAR * a.girth_px]
        near_b = b.pixels[at_b < at_b.min() + _NEAR * b.girth_px]
        apart = near_b.mean(axis=0) - near_a.mean(axis=0)
    return apart / max(float(np.linalg.norm(apart)), 1e-9), near_a, near_b


@dataclass(frozen=True, eq=False)
class _Sections:
    """A part's sections across the frame, near the gap.

    Parameters
    ----------
    girth_px : float
        Their median width.
    long_px : float
        Length along the axis of the complete sections.
    middle_px : float
        Middle of the section nearest to the gap.
    slope : float, optional
        Slope of the middles; None for a short part.
    centre : tuple of float
        Mean s and t of the middles.
    """

    girth_px: float
    long_px: float
    middle_px: float
    slope: float | None
    centre: tuple[float, float]

    @classmethod
    def of(cls, points: NDArray[np.float64], side: int) -> _Sections | None:
        """Return a part's sections; `side` says where it lies along: -1 before the gap, 1 after."""
        row = np.rint(points[:, 0]).astype(int)
        start = int(row.min())
        count = int(row.max()) - start + 1
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, row - start, points[:, 1])
        np.maximum.at(high, row - start, points[:, 1])
        width = high - low + 1
        known = np.isfinite(width)
        if not known.any():
            return None
        girth = float(np.quantile(width[known], 0.6))
        # Sections at an oblique edge are incomplete.
        whole = known & (width > 0.8 * girth)
        s, t = np.flatnonzero(whole) + start, (low[whole] + high[whole]) / 2
        span = float(np.ptp(s)) + 1
        slope = float(np.polyfit(s, t, 1)[0]) if span > _AXIS_SPAN * girth else None
        last = float(t[-1] if side < 0 else t[0])
        return cls(girth, span, last, slope, (float(s.mean()), float(t.mean())))

    def at(self, s: float, other: _Sections) -> float:
        """Return where the axis, or the other part's direction through it, is at s."""
        slope = self.slope if self.slope is not None else other.slope or 0.0
        return self.centre[1] + slope * (s - self.centre[0])


def _edges(
    first: NDArray[np.float64], second: NDArray[np.float64], middle: float, girth: float
) -> NDArray[np.float64]:
    """Return lines along the frame: their t, and where they leave and enter the parts."""
    step = max(1.0, girth / 15)
    edges = []
    for t in np.arange(middle - _SIDES * girth, middle + _SIDES * girth + step / 2, step):
        a, b = (points[np.abs(points[:, 1] - t) <= step / 2, 0] for points in (first, second))
        if len(a) and len(b):
            edges.append((t, a.max(), b.min()))
    return np.array(edges).reshape(-1, 3)


def _something_in_front(
    facing: _Facing, color_rgb: NDArray[np.uint8], depth_m: NDArray[np.float32] | None
) -> bool:
    """Return whether the object between two parts is nearer than the fruit, as far as is known."""
    ridges = [points[np.abs(points[:, 1]) < facing.girth_px / 3] for points in facing.near]
    if depth_m is not None:
        in_front = _depth_shows_in_front(facing, ridges, depth_m)
        if in_front is not None:
            return in_front
    if facing.gap_px > _LONGEST_GAP_UNSEEN * facing.girth_px:
        return False
    return _of_one_color(facing, ridges, color_rgb)


def _depth_shows_in_front(
    facing: _Facing, ridges: Sequence[NDArray[np.float64]], depth_m: NDArray[np.float32]
) -> bool | None:
    """Return whether depth shows an object in front in the gap; None with too few readings."""
    middle = float(facing.edges[:, 1:].mean())
    predicted = [_predicted_depth(facing, ridge, depth_m, middle) for ridge in ridges]
    if predicted[0] is None or predicted[1] is None:
        return None
    far_m = (predicted[0] + predicted[1]) / 2
    if abs(predicted[0] - predicted[1]) > _DEPTH_STEP * far_m:
        return False
    pixels = _inside(facing.gap_pixels(), depth_m.shape)
    readings = depth_m[pixels[:, 1], pixels[:, 0]]
    readings = readings[valid_depth(readings)]
    if facing.gap_px <= _THIN_GAP * facing.girth_px:
        farther = readings > (1 + _FARTHER) * far_m
        return not readings.size or float(farther.mean()) <= _FARTHER_SHARE
    if readings.size < max(5, 0.1 * len(pixels)):
        return None
    return float((readings < (1 - _NEARER) * far_m).mean()) >= _NEARER_SHARE


def _predicted_depth(
    facing: _Facing, ridge: NDArray[np.float64], depth_m: NDArray[np.float32], at: float
) -> float | None:
    """Return the depth that one part's ridge predicts for the middle of the gap, metres."""
    pixels = facing.pixels(ridge[:, 0], ridge[:, 1])
    readings = depth_m[pixels[:, 1], pixels[:, 0]]
    known = valid_depth(readings)
    if np.count_nonzero(known) < 10:
        return None
    s, z = ridge[known, 0], readings[known].astype(np.float64)
    kept = np.abs(z - np.median(z)) < 0.1 * np.median(z)
    s, z = s[kept], z[kept]
    if np.ptp(s) < facing.girth_px:
        return float(np.median(z))
    slope, base = np.polyfit(s, z, 1)
    return float(base + slope * at)


def _of_one_color(
    facing: _Facing, ridges: Sequence[NDArray[np.float64]], color_rgb: NDArray[np.uint8]
) -> bool:
    import cv2

    medians = []
    for ridge in ridges:
        pixels = facing.pixels(ridge[:, 0], ridge[:, 1])
        seen = color_rgb[pixels[:, 1], pixels[:, 0]].astype(np.float32)[None] / 255
        medians.append(np.median(cv2.cvtColor(seen, cv2.COLOR_RGB2LAB)[0], axis=0))
    return float(np.linalg.norm(medians[0] - medians[1])) <= _SAME_COLOR


def _inside(pixels: NDArray[np.intp], shape: tuple[int, ...]) -> NDArray[np.intp]:
    within = (pixels >= 0).all(axis=1) & (pixels[:, 0] < shape[1]) & (pixels[:, 1] < shape[0])
    return pixels[within]


def _joined(a: Instance, b: Instance) -> Instance:
    """Return one instance for both parts."""
    masks = [mask for one in (a, b) if (mask := visible_mask(one)) is not None]
    low, high = np.minimum(a.box, b.box)[:2], np.maximum(a.box, b.box)[2:]
    return replace(
        max(a, b, key=lambda one: one.confidence),
        box=np.concatenate([low, high]),
        detector_mask=np.logical_or.reduce(masks),
        mask=None,
        mask_source=None,
        keypoints=None,
        end_confidence=None,
    )
