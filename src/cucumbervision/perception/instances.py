"""Detected fruit, and the merging of duplicate and partial detections.

Masks identify three kinds of duplicates: two boxes of one fruit (the masks agree), a box within a
box (one mask contains the other), and the parts of a fruit behind a leaf beside the whole (which
contains each part). Parts without the whole share no pixel; only a pose network that sees one fruit
across both distinguishes them from two fruit in a row. Boxes alone are not enough, since crossing
fruit have nested boxes.

A mask that covers two fruit side by side is recognised by its thickness, and its neighbour's pixels
are removed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.perception.boxes import box_areas, box_iou
from cucumbervision.perception.masks import (
    as_mask,
    box_of_mask,
    disjoint_masks,
    mask_pixels,
    mask_window,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

KEYPOINT_NAMES = ("blossom_end", "quarter", "middle", "three_quarters", "stem_end")
"""The five landmarks along a fruit, in the order in which they are stored."""

SKELETON = ((0, 1), (1, 2), (2, 3), (3, 4))
"""Pairs of landmarks that a line joins."""


class MaskSource(StrEnum):
    """Who drew a mask."""

    SAM = "sam"
    DETECTOR = "detector"
    DATASET = "dataset"

    @property
    def words(self) -> str:
        """Name shown to users."""
        return {"sam": "SAM", "detector": "detector", "dataset": "data set"}[self.value]


@dataclass(frozen=True, eq=False)
class Instance:
    """One detected fruit.

    Parameters
    ----------
    box : ndarray of float64, shape (4,)
        x1, y1, x2, y2 of the box's edges in pixels; a mask's box runs from half a pixel outside
        its first pixel centre to half a pixel outside its last.
    confidence : float
        Confidence of the networks, 0 to 1; 1 for boxes and masks drawn by people.
    class_name : str
        Class name.
    mask : ndarray of bool, shape (H, W), optional
        The mask to measure: SAM's or the data set's own; 0/1 and 0/255 are taken too (`as_mask`).
    mask_source : MaskSource, optional
        Who drew `mask`.
    detector_mask : ndarray of bool, shape (H, W), optional
        The detector's own mask, which `best` falls back on.
    keypoints : ndarray of float64, shape (5, 3), optional
        u, v in pixels and visibility 0 to 1 of KP0 (blossom end) to KP4 (stem end).
    mask_failure : str
        Why SAM's mask was rejected ('mask-empty', 'mask-small', 'mask-off-box',
        'mask-off-detector'); empty if not.
    end_confidence : float, optional
        Probability that `keypoints` run from blossom to stem; None if the pose network itself
        orders them.
    input_size_px : int, optional
        Long side of the network input that it was found at, pixels; None if it is not from a
        network.
    """

    box: NDArray[np.float64]
    confidence: float = 1.0
    class_name: str = "cucumber"
    mask: NDArray[np.bool_] | None = None
    mask_source: MaskSource | None = None
    detector_mask: NDArray[np.bool_] | None = None
    keypoints: NDArray[np.float64] | None = None
    mask_failure: str = ""
    end_confidence: float | None = None
    input_size_px: int | None = None

    def __post_init__(self) -> None:
        for name in ("mask", "detector_mask"):
            mask = getattr(self, name)
            if mask is not None and getattr(mask, "dtype", None) != np.bool_:
                object.__setattr__(self, name, as_mask(mask))


_SAME_IOU = 0.5  # of two masks of one fruit
_INSIDE = 0.8  # share of the smaller mask inside the larger one, for masks of one fruit
_SAME_BOX_IOU = 0.7  # of two boxes of one fruit, where there are no masks
_TRUSTED = 0.5  # of the best confidence: least confidence for keeping the largest mask
_SPAN_IOU = 0.75  # between a pose's box and the common box of the parts that it joins
_OWN_IOU = 0.5  # between a part's box and another pose's box: then it is a fruit of its own
_THICKER = 1.6  # thickness of a mask over two fruit, relative to the one found separately
_MUCH_CUT = 0.3  # share of a mask lost to others from which its box is recomputed
_OFF_LINE = 0.15  # of the pose's length: largest distance of a part's centre from its line


def merge_instances(instances: Sequence[Instance]) -> tuple[Instance, ...]:
    """Keep one instance for each fruit.

    Two instances are one fruit when their masks have an IoU of at least 0.5, or when 80 % of the
    smaller mask lies in the larger; without masks, when their boxes have an IoU of at least 0.7.
    Crossing fruit share only the crossing. A mask that contains another one covers two fruit, which
    stay separate, if it is 1.6 times as thick, has a lower confidence, and its remainder is about
    as large as the other. An instance that contains two or more others that are separate is the
    fruit of which they are parts if its confidence is at least their mean; otherwise it is a box
    around several fruit and is removed.

    Parameters
    ----------
    instances : sequence of Instance
        From one detector; `detector_mask`, or else `mask`, is compared.

    Returns
    -------
    tuple of Instance
        Best first. The instance with the largest mask is kept for each fruit, unless its confidence
        is below half of the best. It gets the best confidence, and the best instance's keypoints if
        it has none.

    Examples
    --------
    >>> from cucumbervision.perception.masks import box_of_mask
    >>> whole, part, other = (np.zeros((20, 60), bool) for _ in range(3))
    >>> whole[5:15, 5:45] = part[5:15, 5:25] = other[5:15, 46:56] = True
    >>> found = [
    ...     Instance(box_of_mask(m), c, detector_mask=m)
    ...     for m, c in ((part, 0.8), (whole, 0.6), (other, 0.7))
    ... ]
    >>> [(one.confidence, one.box.tolist()) for one in merge_instances(found)]
    [(0.8, [4.5, 4.5, 44.5, 14.5]), (0.7, [45.5, 4.5, 55.5, 14.5])]
    """
    found = sorted((_Region.of(one) for one in instances), key=_best_first)
    found = [one for one in found if not _around_several(one, found)]
    groups: list[list[_Region]] = []
    # The largest first, each compared only with the largest of a group: a small mask inside two
    # fruit joins one of them without merging both.
    for one in sorted(found, key=lambda one: -one.area):
        own = max(groups, key=lambda group: _shared(one, group[0]), default=None)
        if own is not None and _same(one, own[0]):
            own.append(one)
        else:
            groups.append([one])
    return tuple(sorted(map(_kept, groups), key=lambda one: -one.confidence))


def join_pieces(instances: Sequence[Instance], poses: Sequence[Instance]) -> tuple[Instance, ...]:
    """Join the parts of a fruit behind a leaf where a pose network sees the whole.

    A pose whose keypoints run through two or more instances joins them if their common box has an
    IoU of at least 0.75 with the pose's box, more than each of them alone, and none of them matches
    another pose (IoU 0.5). Two fruit in a row therefore stay separate.

    Parameters
    ----------
    instances : sequence of Instance
        After `merge_instances`.
    poses : sequence of Instance
        After `merge_instances` too, with keypoints; others join nothing.

    Returns
    -------
    tuple of Instance
        Best first. Joined: the common box and mask, the best confidence, the pose's keypoints.

    Examples
    --------
    >>> from cucumbervision.perception.masks import box_of_mask
    >>> left, right = np.zeros((20, 60), bool), np.zeros((20, 60), bool)
    >>> left[5:15, 5:25] = right[5:15, 30:55] = True
    >>> pieces = [Instance(box_of_mask(m), detector_mask=m) for m in (left, right)]
    >>> line = np.array([[u, 9.5, 1.0] for u in (6, 18, 30, 42, 54)])
    >>> pose = Instance(np.array([4.5, 4.5, 54.5, 14.5]), keypoints=line)
    >>> [one.box.tolist() for one in join_pieces(pieces, [pose])]
    [[4.5, 4.5, 54.5, 14.5]]
    """
    left = list(instances)
    for pose in poses:
        pieces = [one for one in left if _is_piece(one, pose, poses)]
        if len(pieces) < 2:
            continue
        edges = np.array([one.box for one in pieces])
        box = np.concatenate([edges[:, :2].min(axis=0), edges[:, 2:].max(axis=0)])
        alone = max(box_iou(one.box, pose.box) for one in pieces)
        if box_iou(box, pose.box) < max(_SPAN_IOU, alone):
            continue
        left = [one for one in left if one not in pieces]
        left.append(_joined(pieces, box, pose))
    return tuple(sorted(left, key=lambda one: -one.confidence))


def each_once(
    found: Sequence[Instance], posed: Sequence[Instance], sure: float = 0.0
) -> tuple[Instance, ...]:
    """Merge the detections of two networks into one instance per fruit, with keypoints.

    Parameters
    ----------
    found : sequence of Instance
        Of the detector, after `merge_instances`.
    posed : sequence of Instance
        Of the pose network, as it gives them.
    sure : float
        Poses with at least this confidence join parts and are matched first.

    Returns
    -------
    tuple of Instance
        Best first: parts joined, keypoints where a pose matches.
    """
    poses = merge_instances(posed)
    whole = join_pieces(found, [pose for pose in poses if pose.confidence > sure])
    return with_keypoints(whole, poses, sure=sure)


def apart(
    instances: Sequence[Instance], depth_m: NDArray[np.float32] | None = None
) -> tuple[Instance, ...]:
    """Assign each pixel that several masks share to one fruit, as `disjoint_masks` does.

    Parameters
    ----------
    instances : sequence of Instance
        After `merge_instances`; `detector_mask` is shared out.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres; 0 where there is no reading.

    Returns
    -------
    tuple of Instance
        In their order. A mask that loses 30 % or more gets a new box; an empty one is removed.
    """
    masks = [one.detector_mask for one in instances]
    left = disjoint_masks(masks, [one.confidence for one in instances], depth_m)
    out = []
    for one, before, after in zip(instances, masks, left, strict=True):
        if before is None or after is None or after is before:
            out.append(one)
        elif after.any():
            much = np.count_nonzero(after) < (1 - _MUCH_CUT) * np.count_nonzero(before)
            box = box_of_mask(after) if much else one.box
            out.append(replace(one, box=box, detector_mask=after))
    return tuple(out)


def with_keypoints(
    instances: Sequence[Instance],
    poses: Sequence[Instance],
    min_iou: float = 0.5,
    *,
    sure: float = 0.0,
) -> tuple[Instance, ...]:
    """Return instances with the keypoints of the matching poses.

    Boxes are matched one to one, with the largest sum of overlaps.

    Parameters
    ----------
    instances : sequence of Instance
        From a segmenting network, or from anywhere.
    poses : sequence of Instance
        With keypoints.
    min_iou : float
        Least overlap of the two boxes.
    sure : float
        Poses above this confidence are matched first, the others with the remaining instances.

    Returns
    -------
    tuple of Instance
        The instances in their order; those without a match keep what they had.

    Examples
    --------
    >>> fruit = Instance(np.array([0.0, 0, 10, 40]))
    >>> pose = Instance(np.array([0.0, 0, 10, 38]), keypoints=np.zeros((5, 3)))
    >>> with_keypoints([fruit], [pose])[0].keypoints.shape
    (5, 3)
    """
    out = list(instances)
    left = list(range(len(out)))
    for some in (
        [p for p in poses if p.confidence > sure],
        [p for p in poses if p.confidence <= sure],
    ):
        for i, pose in _matches([out[k] for k in left], some, min_iou):
            out[left[i]] = replace(
                out[left[i]], keypoints=pose.keypoints, end_confidence=pose.end_confidence
            )
        left = [k for k in left if out[k].keypoints is None]
    return tuple(out)


def _matches(
    instances: Sequence[Instance], poses: Sequence[Instance], min_iou: float
) -> list[tuple[int, Instance]]:
    """Match instances, by their place, with poses that have keypoints."""
    if not instances or not poses:
        return []
    from scipy.optimize import linear_sum_assignment

    overlaps = np.array([[box_iou(a.box, b.box) for b in poses] for a in instances])
    # Pairs below the threshold count 0, so that they cannot displace a good pair.
    overlaps[overlaps < min_iou] = 0.0
    pairs = zip(*(k.tolist() for k in linear_sum_assignment(overlaps, maximize=True)), strict=True)
    return [
        (i, poses[j]) for i, j in pairs if overlaps[i, j] > 0 and poses[j].keypoints is not None
    ]


@dataclass(frozen=True, eq=False)
class _Region:
    """An instance with its mask, the mask's window, and the pixels in it."""

    instance: Instance
    mask: NDArray[np.bool_] | None
    window: tuple[slice, slice] | None
    area: float

    @classmethod
    def of(cls, instance: Instance) -> _Region:
        mask = visible_mask(instance)
        window = None if mask is None else mask_window(mask)
        if mask is None or window is None:
            return cls(instance, None, None, float(box_areas(instance.box[None])[0]))
        return cls(instance, mask, window, float(np.count_nonzero(mask[window])))


def visible_mask(instance: Instance) -> NDArray[np.bool_] | None:
    """Return the detector's own mask, or the measured mask without one."""
    return instance.mask if instance.detector_mask is None else instance.detector_mask


def _best_first(one: _Region) -> tuple[float, float]:
    return -one.instance.confidence, -one.area


def _shared(a: _Region, b: _Region) -> float:
    """Return the number of shared pixels of two masks, or the overlap of boxes without masks."""
    if a.mask is None or b.mask is None or a.window is None or b.window is None:
        return box_iou(a.instance.box, b.instance.box)
    rows, columns = (
        slice(max(own.start, other.start), min(own.stop, other.stop))
        for own, other in zip(a.window, b.window, strict=True)
    )
    return float(np.count_nonzero(a.mask[rows, columns] & b.mask[rows, columns]))


def _same(a: _Region, b: _Region) -> bool:
    if a.mask is None or b.mask is None:
        return box_iou(a.instance.box, b.instance.box) >= _SAME_BOX_IOU
    shared = _shared(a, b)
    if shared >= _SAME_IOU * (a.area + b.area - shared) or _inside(shared, a, b):
        return not _over_two(*sorted((a, b), key=lambda one: one.area))
    return False


def _inside(shared: float, a: _Region, b: _Region) -> bool:
    return shared >= _INSIDE * min(a.area, b.area)


def _over_two(part: _Region, whole: _Region) -> bool:
    """Return whether a mask covers another instance's fruit and a fruit beside it."""
    if whole.mask is None or part.mask is None or whole.window is None:
        return False
    if whole.instance.confidence > part.instance.confidence:
        return False
    rest = whole.mask[whole.window] & ~part.mask[whole.window]
    sides = [_sides(one) for one in (part.mask[whole.window], whole.mask[whole.window], rest)]
    (long, thick), (_, of_both), (of_rest, thick_rest) = sides
    return (
        of_both >= _THICKER * thick
        and thick / _THICKER <= thick_rest <= _THICKER * thick
        and of_rest >= long / 2
    )


def _sides(mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the longer and the shorter side of the rectangle with a mask's second moments."""
    v, u = np.nonzero(mask)
    if len(v) < 2:
        return 0.0, 0.0
    short, long = np.sqrt(12 * np.clip(np.linalg.eigvalsh(np.cov(np.stack([u, v]))), 0, None))
    return float(long), float(short)


def _around_several(one: _Region, found: Sequence[_Region]) -> bool:
    """Return whether an instance is a box around several fruit that were also found separately."""
    if one.mask is None:
        return False
    parts: list[_Region] = []
    for other in found:
        # An instance that matches the whole is a duplicate, not a part.
        if other is one or other.mask is None or other.area >= one.area:
            continue
        shared = _shared(one, other)
        if shared >= _INSIDE * other.area and not any(_same(other, part) for part in parts):
            parts.append(other)
    if len(parts) < 2:
        return False
    return float(np.mean([part.instance.confidence for part in parts])) > one.instance.confidence


def _kept(group: Sequence[_Region]) -> Instance:
    members = sorted(group, key=_best_first)
    best = members[0].instance.confidence
    trusted = [one for one in members if one.instance.confidence >= _TRUSTED * best]
    kept = max(trusted, key=lambda one: one.area).instance
    posed = [one for one in (kept, *(m.instance for m in members)) if one.keypoints is not None]
    if not posed:
        return replace(kept, confidence=best)
    return replace(
        kept, confidence=best, keypoints=posed[0].keypoints, end_confidence=posed[0].end_confidence
    )


def _is_piece(one: Instance, pose: Instance, poses: Sequence[Instance]) -> bool:
    mask = visible_mask(one)
    if pose.keypoints is None or mask is None:
        return False
    if any(box_iou(one.box, other.box) >= _OWN_IOU for other in poses if other is not pose):
        return False
    pixels = mask_pixels(mask)
    if not len(pixels):
        return False
    line = np.asarray(pose.keypoints[:, :2], np.float64)
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    return _distance(pixels.mean(axis=0), line) <= _OFF_LINE * length


def _distance(point: NDArray[np.float64], line: NDArray[np.float64]) -> float:
    """Return a point's distance to a polyline, shape (K, 2)."""
    steps = np.diff(line, axis=0)
    squares = np.maximum((steps**2).sum(axis=1), 1e-12)
    along = np.clip(((point - line[:-1]) * steps).sum(axis=1) / squares, 0, 1)
    near = line[:-1] + along[:, None] * steps
    return float(np.linalg.norm(near - point, axis=1).min())


def _joined(pieces: Sequence[Instance], box: NDArray[np.float64], pose: Instance) -> Instance:
    best = max(pieces, key=lambda one: one.confidence)
    masks = [mask for one in pieces if (mask := visible_mask(one)) is not None]
    mask = np.logical_or.reduce(masks)
    return replace(
        best,
        box=box,
        detector_mask=mask,
        keypoints=pose.keypoints,
        end_confidence=pose.end_confidence,
    )
