"""Join the parts of a fruit that is split by a leaf or string.

From both ends of a detection's mask, consecutive sections across its axis are examined. A section
continues the fruit if detections, including weak ones, cover it at the fruit's distance. A nearer
object may occlude up to 2.5 diameters. Anything else may be a string, which a depth camera does not
detect, up to 0.35 diameters. A gap that widens towards its sides separates two round ends.
Detections along the continued fruit are parts of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.geometry.axis import principal_axis
from cucumbervision.geometry.pixels import quick_median
from cucumbervision.instances.masks import box_of_mask, mask_pixels, mask_window

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.instances.instance import Instance

    Array = NDArray[np.float64]

# Lengths are in diameters.
_LONGEST_FRUIT = 12.0  # of the whole fruit
_LONGEST_COVERED = 2.5  # in one piece, by something nearer
_LONGEST_GAP = 0.35  # neither fruit nor hidden: a string's
_GAP_ROUNDING = 0.15  # by which a gap is wider at its sides; between two round ends it is 0.3
_SHORTEST_PIECE = 0.6  # that is added
_SECTION_WIDTH, _ADDED_WIDTH = 0.8, 1.2  # sections that are examined, and that are added
_DIRECTION_LENGTH = 2.5  # length of the mask, from its end, that gives the direction
_TORN_EDGE = 0.5  # of that: left out, since an edge there may be torn
_COVERED_SHARE = 0.7  # share of a section
_SAME_M, _NEARER_M, _BODY_M = 0.02, 0.01, 0.06  # between readings and the depth that is expected
_TURN_RATE, _SHIFT_RATE = 0.15, 0.3  # how fast direction and position follow the sections
_STEEPEST = 0.6  # between the direction at an end and the mask's axis
_PART_SHARE = 0.6  # share of a detection in what is added, from which it is a part of the fruit
_FOREIGN_SHARE = 0.3  # share of what is added, from which it belongs to another detection
_LEAST_PIXELS = 30  # pixels and readings of a body


def join_pieces_by_depth(
    fruit: Sequence[Instance], weak: Sequence[Instance], depth_m: NDArray[np.float32]
) -> tuple[Instance, ...]:
    """Complete partly occluded fruit, and join their detected parts.

    Parameters
    ----------
    fruit : sequence of Instance
        Instances with the detector's masks; those without are returned unchanged.
    weak : sequence of Instance
        Detections below the threshold, which may continue a fruit.
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour; 0 for no reading.

    Returns
    -------
    tuple of Instance
        Best first. A completed instance has the joint box and mask, the best confidence and no
        keypoints.

    Examples
    --------
    >>> from cucumbervision.instances.instance import Instance
    >>> upper, lower = np.zeros((200, 60), bool), np.zeros((200, 60), bool)
    >>> upper[10:100, 20:40] = lower[104:180, 20:40] = True
    >>> upper_part, weak = (Instance(box_of_mask(m), detector_mask=m) for m in (upper, lower))
    >>> depth = np.full((200, 60), 0.5, np.float32)
    >>> join_pieces_by_depth([upper_part], [weak], depth)[0].box.tolist()
    [19.5, 9.5, 39.5, 179.5]
    """
    cover = np.zeros(depth_m.shape, bool)
    for instance in (*fruit, *weak):
        if instance.detector_mask is not None:
            cover |= instance.detector_mask
    waiting = sorted(fruit, key=_area, reverse=True)
    done: list[Instance] = []
    while waiting:
        body_part = waiting.pop(0)
        added = (
            None
            if body_part.detector_mask is None
            else _continuation(body_part.detector_mask, cover, depth_m)
        )
        if added is not None:
            shares = [_shared(candidate, added) for candidate in waiting]
            parts = [
                candidate
                for candidate, (share, _) in zip(waiting, shares, strict=True)
                if share >= _PART_SHARE
            ]
            covered_shares = [*(of_added for share, of_added in shares if share < _PART_SHARE)]
            covered_shares += [_shared(joined, added)[1] for joined in done]
            if max(covered_shares, default=0.0) <= _FOREIGN_SHARE:
                waiting = [
                    candidate
                    for candidate in waiting
                    if not any(candidate is part for part in parts)
                ]
                body_part = _completed(body_part, parts, added)
        done.append(body_part)
    return tuple(sorted(done, key=lambda instance: -instance.confidence))


def _area(instance: Instance) -> int:
    return 0 if instance.detector_mask is None else int(np.count_nonzero(instance.detector_mask))


def _shared(instance: Instance, added: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the share of a detection inside the added pixels, and the reverse share."""
    if instance.detector_mask is None:
        return 0.0, 0.0
    shared = int(np.count_nonzero(instance.detector_mask & added))
    return shared / max(_area(instance), 1), shared / int(np.count_nonzero(added))


def _completed(instance: Instance, parts: Sequence[Instance], added: NDArray[np.bool_]) -> Instance:
    masks = [part.detector_mask for part in (instance, *parts) if part.detector_mask is not None]
    mask = np.logical_or.reduce([*masks, added])
    return replace(
        instance,
        confidence=max(part.confidence for part in (instance, *parts)),
        box=box_of_mask(mask),
        detector_mask=mask,
        mask=None,
        mask_source=None,
        keypoints=None,
        end_confidence=None,
    )


@dataclass(frozen=True, eq=False)
class _Body:
    """A mask along its principal axis.

    Parameters
    ----------
    points : ndarray of float64, shape (2, N)
        Its pixels from their centre, along the axis and across.
    centre : ndarray of float64, shape (2,)
        u, v.
    axes : ndarray of float64, shape (2, 2)
        Unit vectors along and across.
    girth_px : float
        Width of its thicker sections.
    depth : ndarray of float64, shape (2,)
        Slope and base of its depth along the axis, metres.
    """

    points: Array
    centre: Array
    axes: Array
    girth_px: float
    depth: Array

    @classmethod
    def of(cls, mask: NDArray[np.bool_], depth_m: NDArray[np.float32]) -> _Body | None:
        """Return None if the mask is too small, too short or without depth."""
        pixels = mask_pixels(mask)
        if len(pixels) < _LEAST_PIXELS:
            return None
        centre, axis = principal_axis(pixels)
        axes = np.array([axis, [-axis[1], axis[0]]])
        points = np.ascontiguousarray(((pixels - centre) @ axes.T).T)
        counts = np.bincount((points[0] - points[0].min()).astype(int))
        girth_px = float(np.quantile(counts[counts > 0], 0.75))
        window = mask_window(mask) or ...
        readings = depth_m[window][mask[window]]
        is_read = valid_depth(readings)
        if is_read.any():
            is_read &= np.abs(readings - np.median(readings[is_read])) < _BODY_M
        if (
            np.count_nonzero(is_read) < _LEAST_PIXELS
            or np.ptp(points[0]) < _SECTION_WIDTH * girth_px
        ):
            return None
        positions_px = points[0, is_read]
        body_m = readings[is_read].astype(np.float64)
        is_long = np.ptp(positions_px) > 1.5 * girth_px
        depth = _line(positions_px, body_m) if is_long else (0.0, float(body_m.mean()))
        return cls(points, centre, axes, girth_px, np.array(depth))

    def end(self, side: int) -> tuple[float, Array, Array]:
        """Return the position of one end on the axis and in the picture, and its direction."""
        along, across = side * self.points[0], self.points[1]
        last = float(along.max())
        at_end = along > last - _DIRECTION_LENGTH * self.girth_px
        is_smooth = at_end & (along < last - _TORN_EDGE * self.girth_px)
        slope, base = 0.0, float(across[at_end].mean())
        if is_smooth.any() and np.ptp(along[is_smooth]) > self.girth_px:
            slope, base = _line(along[is_smooth], across[is_smooth])
        slope = float(np.clip(slope, -_STEEPEST, _STEEPEST))
        ahead = side * self.axes[0] + slope * self.axes[1]
        # Start inside the mask, so that a round end is recognised.
        start = last - _TORN_EDGE * self.girth_px
        tip = self.centre + side * start * self.axes[0] + (base + slope * start) * self.axes[1]
        return side * start, tip, ahead / np.linalg.norm(ahead)


def _line(x: Array, y: Array) -> tuple[float, float]:
    """Return slope and base of the line through points by least squares."""
    off = x - x.mean()
    slope = float(off @ y / (off @ off))
    return slope, float(y.mean() - slope * x.mean())


def _continuation(
    mask: NDArray[np.bool_], cover: NDArray[np.bool_], depth_m: NDArray[np.float32]
) -> NDArray[np.bool_] | None:
    """Return the covered pixels that continue a mask beyond its ends; None without any."""
    body = _Body.of(mask, depth_m)
    if body is None:
        return None
    edges = [_sections(body, side, cover, depth_m) for side in (-1, 1)]
    outlines = [np.concatenate([pair[:, 0], pair[::-1, 1]]) for pair in edges if pair is not None]
    if not outlines:
        return None
    added = np.zeros(mask.shape, np.uint8)
    for outline in outlines:
        cv2.fillPoly(added, [np.rint(outline).astype(np.int32)], 1)
    added_part = (added > 0) & cover & ~mask
    return added_part if added_part.any() else None


def _sections(
    body: _Body, side: int, cover: NDArray[np.bool_], depth_m: NDArray[np.float32]
) -> Array | None:
    """Return both edges of the sections beyond one end, shape (N, 2, 2); None if it ends there."""
    girth = body.girth_px
    place, position, ahead = body.end(side)
    step = max(girth / 8, 1.0)
    across = np.linspace(-_SECTION_WIDTH / 2, _SECTION_WIDTH / 2, 11)
    parts = (
        np.abs(across) < _SECTION_WIDTH / 5,
        across < -_SECTION_WIDTH / 3,
        across > _SECTION_WIDTH / 3,
    )
    sizes, (slope, base) = [np.count_nonzero(part) for part in parts], body.depth.tolist()
    edges: list[Any] = []
    last, seen_px, open_px, hidden_px, rounded_px = 0, 0.0, 0.0, 0.0, 0.0
    for _ in range(int((_LONGEST_FRUIT * girth - np.ptp(body.points[0])) / step)):
        place, position = place + side * step, position + step * ahead
        aside = np.array([-ahead[1], ahead[0]])
        pixels = np.rint(position + girth * across[:, None] * aside).astype(np.intp)
        if not np.all((pixels >= 0) & (pixels < (cover.shape[1], cover.shape[0]))):
            break
        edges.append(position + np.outer([-_ADDED_WIDTH / 2, _ADDED_WIDTH / 2], girth * aside))
        covered = cover[pixels[:, 1], pixels[:, 0]]
        farther_m = _farther(depth_m[pixels[:, 1], pixels[:, 0]], slope * place + base)
        in_middle, *beside = (
            np.count_nonzero(covered & part) / size for part, size in zip(parts, sizes, strict=True)
        )
        beside_share = max(beside)  # at a bend, only one side may be open
        rounded_px += step * (in_middle - beside_share)
        if np.count_nonzero(covered) >= _COVERED_SHARE * len(covered) and abs(farther_m) <= _SAME_M:
            if rounded_px > _GAP_ROUNDING * girth:
                break
            if beside_share == 1:
                rounded_px = 0.0
            last, seen_px, open_px, hidden_px = len(edges), seen_px + step, 0.0, 0.0
            off = float(across[covered].mean())
            position, ahead = (
                position + _SHIFT_RATE * off * girth * aside,
                ahead + _TURN_RATE * off * aside,
            )
            ahead /= np.linalg.norm(ahead)
        elif farther_m < -_NEARER_M:
            hidden_px += step
        else:
            open_px += step
        if open_px > _LONGEST_GAP * girth or hidden_px > _LONGEST_COVERED * girth:
            break
    # The first half diameter belongs to the mask.
    return np.array(edges[:last]) if seen_px >= (_SHORTEST_PIECE + _TORN_EDGE) * girth else None


def _farther(readings: NDArray[np.float32], expected_m: float) -> float:
    """Return how much farther a section is than expected; 0 with too few readings."""
    valid = readings[valid_depth(readings)]
    return float(quick_median(valid)) - expected_m if len(valid) > 2 else 0.0
