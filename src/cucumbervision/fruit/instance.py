"""Detected fruit, and the merging of duplicate detections.

Masks identify three kinds of duplicates: two boxes of one fruit (the masks agree), a box within a
box (one mask contains the other), and the parts of a fruit behind a leaf beside the whole (which
contains each part). Boxes alone are not enough, since crossing fruit have nested boxes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Self

import numpy as np

from cucumbervision.arrays import Array, Array32, Mask, Numbers
from cucumbervision.errors import InstancesError
from cucumbervision.fruit.masks import (
    as_mask,
    box_areas,
    box_iou,
    box_ious,
    box_of_mask,
    disjoint_masks,
    mask_window,
    overlap,
)

KEYPOINT_NAMES = ("blossom_end", "quarter", "middle", "three_quarters", "stem_end")
"""The five landmarks along a fruit, in the order in which they are stored."""

MASK_FAILURES = ("mask-empty", "mask-small", "mask-off-box", "mask-off-detector")
"""Why a segmenter's mask was rejected."""

LEAST_END_CONFIDENCE = 0.9
"""Least probability at which a fruit's ends count as known."""

UNKNOWN_ORDER = 0.5
"""`Instance.end_confidence` of keypoints that a network ordered by place."""

SKELETON = ((0, 1), (1, 2), (2, 3), (3, 4))
"""Pairs of landmarks that a line joins."""


class MaskSource(StrEnum):
    """Source of a mask; 'segmenter' is any segmenter other than SAM."""

    SAM = "sam"
    SEGMENTER = "segmenter"
    DETECTOR = "detector"
    DATASET = "dataset"
    HAND = "hand"

    @property
    def words(self) -> str:
        """Name shown to users."""
        return {"sam": "SAM", "dataset": "data set"}.get(self.value, self.value)


_FAR_PX = 1e6  # from the image
_ROUNDING_PX = 0.51  # boxes relative to the corner of the image extend half a pixel beyond it
_OWN_SIZE = "give masks of the picture's own size"
_CORNERS = "give x1, y1, x2, y2 in pixels, the corners from the upper left to the lower right"


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
        The mask to measure, of a segmenter or a data set; 0/1 and 0/255 are converted (`as_mask`).
    mask_source : MaskSource, optional
        Source of `mask`.
    detector_mask : ndarray of bool, shape (H, W), optional
        The detector's own mask, which `best` falls back on.
    keypoints : ndarray of float64, shape (5, 3), optional
        u, v in pixels and visibility 0 to 1 of KP0 (blossom end) to KP4 (stem end).
    mask_failure : str
        Why SAM's mask was rejected, one of `MASK_FAILURES`; empty if not.
    end_confidence : float, optional
        Probability that `keypoints` run from blossom to stem; None if the pose network itself
        orders them.
    input_size_px : int, optional
        Long side of the network input that it was found at, pixels; None if it is not from a
        network.
    is_clipped : bool
        Whether the box extended beyond the image and was clipped to it.
    """

    box: Array
    confidence: float = 1.0
    class_name: str = "cucumber"
    mask: Mask | None = field(default=None, repr=False)
    mask_source: MaskSource | None = None
    detector_mask: Mask | None = field(default=None, repr=False)
    keypoints: Array | None = field(default=None, repr=False)
    mask_failure: str = ""
    end_confidence: float | None = None
    input_size_px: int | None = None
    is_clipped: bool = False

    def __post_init__(self) -> None:
        for name in ("mask", "detector_mask"):
            mask = getattr(self, name)
            if mask is not None and getattr(mask, "dtype", None) != np.bool_:
                object.__setattr__(self, name, as_mask(mask))

    def turned(self, quarters: int, shape: tuple[int, int]) -> Self:
        """Return the instance as it lies in the picture turned by quarters, as `np.rot90` does.

        Parameters
        ----------
        quarters : int
            Quarter turns, counterclockwise.
        shape : tuple of int
            Height and width of the picture before it is turned.

        Examples
        --------
        >>> Instance(np.array([0.0, 0.0, 9.0, 30.0])).turned(1, (100, 40)).box.tolist()
        [0.0, 30.0, 30.0, 39.0]
        """
        if not quarters:
            return self
        size = np.array(shape[::-1])
        turn = np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), quarters % 4)

        def placed(points: Array) -> Array:
            return np.asarray((points - (size - 1) / 2) @ turn.T + (abs(turn) @ size - 1) / 2)

        corners, points = placed(self.box.reshape(2, 2)), self.keypoints
        masks: dict[str, Any] = {
            name: mask if mask is None else np.ascontiguousarray(np.rot90(mask, quarters))
            for name, mask in (("mask", self.mask), ("detector_mask", self.detector_mask))
        }
        return replace(
            self,
            box=np.concatenate([corners.min(axis=0), corners.max(axis=0)]),
            **masks,
            keypoints=None if points is None else np.c_[placed(points[:, :2]), points[:, 2]],
        )

    @classmethod
    def of_mask(cls, mask: Numbers, source: MaskSource = MaskSource.DATASET) -> Self:
        """Create an instance from a mask alone.

        Parameters
        ----------
        mask : ndarray, shape (H, W)
            bool, 0/1 or 0/255.
        source : MaskSource
            Source of the mask; lengths from masks of networks have wider intervals.

        Raises
        ------
        InstancesError
            If it is not a mask, or is empty.

        Examples
        --------
        >>> mask = np.zeros((20, 60), np.uint8)
        >>> mask[5:15, 10:50] = 255
        >>> Instance.of_mask(mask).box.tolist()
        [9.5, 4.5, 49.5, 14.5]
        """
        pixels = as_mask(mask)
        if not pixels.any():
            raise InstancesError("a mask has no pixel", remedy="leave it out")
        return cls(box_of_mask(pixels), mask=pixels, mask_source=source)


def in_picture(instance: Instance, width: int, height: int) -> Instance:
    """Return an instance with its box cut to the picture.

    Raises
    ------
    InstancesError
        If a mask has another size or no pixel, the box is not finite, has no area or lies outside,
        the confidence is not between 0 and 1, or the keypoints are not (5, 3) numbers.

    Examples
    --------
    >>> in_picture(Instance(np.array([0.0, 0.0, np.nan, 8.0])), 64, 48)
    Traceback (most recent call last):
    ...
    cucumbervision.errors.InstancesError: the box [0, 0, nan, 8] is not finite; ...
    """
    for mask in (instance.mask, instance.detector_mask):
        if mask is not None:
            sizes = {"mask": f"{mask.shape[1]}x{mask.shape[0]}", "picture": f"{width}x{height}"}
            fault, remedy = "the mask is {mask}, the picture {picture}", _OWN_SIZE
            _require(mask.shape == (height, width), fault, remedy, **sizes)
            _require(bool(mask.any()), "a mask has no pixel", "leave it out")
    keypoints = instance.keypoints
    if keypoints is not None:
        keypoints = np.asarray(keypoints, np.float64)
        is_five = keypoints.shape == (len(KEYPOINT_NAMES), 3)
        fault = f"the keypoints are {keypoints.shape} numbers up to {np.abs(keypoints).max():g}"
        remedy = "give u and v in pixels and the visibility of each, (5, 3)"
        _require(is_five and not (np.abs(keypoints) > _FAR_PX).any(), fault, remedy)
    box = np.asarray(instance.box, np.float64)
    text = f"the box [{', '.join(f'{edge:g}' for edge in box.ravel())}]"
    is_box = box.shape == (4,) and bool(np.isfinite(box).all())
    _require(is_box, f"{text} is not finite", "give x1, y1, x2, y2 in pixels")
    corner, opposite = np.maximum(box[:2], -0.5), np.minimum(box[2:], (width - 0.5, height - 0.5))
    fault = f"{text} has no area inside the picture of {width}x{height}"
    _require(not (opposite <= corner).any(), fault, _CORNERS)
    confidence, remedy = float(instance.confidence), "give a number from 0 to 1"
    _require(0 <= confidence <= 1, f"the confidence is {confidence:g}", remedy)
    inside = np.concatenate([corner, opposite])
    return replace(
        instance,
        box=inside,
        is_clipped=instance.is_clipped or bool(np.abs(inside - box).max() > _ROUNDING_PX),
        confidence=confidence,
        keypoints=keypoints,
        mask_failure=instance.mask_failure if instance.mask_failure in MASK_FAILURES else "",
    )


def _require(is_right: bool, fault: str, remedy: str, **parts: object) -> None:
    if not is_right:
        raise InstancesError(fault, remedy=remedy, **parts)


TRUSTED_SHARE = 0.5
"""Share of a fruit's best confidence from which another detection of it may give the mask."""

_SAME_IOU = 0.5  # of two masks of one fruit, and of the boxes of a fruit and its keypoints
_INSIDE = 0.8  # share of the smaller mask inside the larger one, for masks of one fruit
_SAME_BOX_IOU = 0.7  # of two boxes of one fruit, where there are no masks
_MUCH_CUT = 0.3  # share of a mask lost to others from which its box is recomputed


def merge_instances(instances: Sequence[Instance]) -> tuple[Instance, ...]:
    """Keep one instance for each fruit.

    Two instances are one fruit when their masks have an IoU of at least 0.5, or when 80 % of the
    smaller mask lies in the larger; without masks, when their boxes have an IoU of at least 0.7.
    Crossing fruit share only the crossing. An instance that contains two or more others that are
    separate is the fruit of which they are parts if its confidence is at least their mean;
    otherwise it is a box around several fruit and is removed.

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
    >>> from cucumbervision.fruit.masks import box_of_mask
    >>> whole_fruit, part, separate = (np.zeros((20, 60), bool) for _ in range(3))
    >>> whole_fruit[5:15, 5:45] = part[5:15, 5:25] = separate[5:15, 46:56] = True
    >>> detections = [
    ...     Instance(box_of_mask(m), c, detector_mask=m)
    ...     for m, c in ((part, 0.8), (whole_fruit, 0.6), (separate, 0.7))
    ... ]
    >>> merged = merge_instances(detections)
    >>> [(detection.confidence, detection.box.tolist()) for detection in merged]
    [(0.8, [4.5, 4.5, 44.5, 14.5]), (0.7, [45.5, 4.5, 55.5, 14.5])]
    """
    regions = sorted((_Region.of(instance) for instance in instances), key=_best_first)
    regions = [region for region in regions if not _around_several(region, regions)]
    groups: list[list[_Region]] = []
    # The largest first, each compared only with the largest of a group: a small mask inside two
    # fruit joins one of them without merging both.
    for region in sorted(regions, key=lambda region: -region.area):
        group = max(groups, key=lambda group: _shared(region, group[0]), default=None)
        if group is not None and _same(region, group[0]):
            group.append(region)
        else:
            groups.append([region])
    return tuple(sorted(map(_merged_instance, groups), key=lambda instance: -instance.confidence))


def with_disjoint_masks(
    instances: Sequence[Instance], depth_m: Array32 | None = None
) -> tuple[Instance, ...]:
    """Assign each pixel that several masks share to one fruit, as `disjoint_masks` does.

    Parameters
    ----------
    instances : sequence of Instance
        Result of `merge_instances`; the pixels of `detector_mask` are assigned.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres; 0 where there is no reading.

    Returns
    -------
    tuple of Instance
        In their order. A mask that loses 30 % or more gets a new box; an empty one is removed.
    """
    masks = [instance.detector_mask for instance in instances]
    disjoint = disjoint_masks(masks, [instance.confidence for instance in instances], depth_m)
    out = []
    for instance, before, after in zip(instances, masks, disjoint, strict=True):
        if before is None or after is None or after is before:
            out.append(instance)
        elif after.any():
            much = np.count_nonzero(after) < (1 - _MUCH_CUT) * np.count_nonzero(before)
            box = box_of_mask(after) if much else instance.box
            out.append(replace(instance, box=box, detector_mask=after))
    return tuple(out)


def with_keypoints(
    instances: Sequence[Instance], poses: Sequence[Instance], *, sure: float = 0.0
) -> tuple[Instance, ...]:
    """Return instances with the keypoints of the matching poses.

    Boxes are matched one to one, with the largest sum of overlaps.

    Parameters
    ----------
    instances : sequence of Instance
        Instances of any source.
    poses : sequence of Instance
        With keypoints.
    sure : float
        Poses above this confidence are matched first, the others with the remaining instances.

    Returns
    -------
    tuple of Instance
        The instances in their order; those without a match are unchanged.

    Examples
    --------
    >>> fruit = Instance(np.array([0.0, 0, 10, 40]))
    >>> pose = Instance(np.array([0.0, 0, 10, 38]), keypoints=np.zeros((5, 3)))
    >>> with_keypoints([fruit], [pose])[0].keypoints.shape
    (5, 3)
    """
    from scipy.optimize import linear_sum_assignment

    poses = [pose for pose in poses if pose.keypoints is not None]
    boxes, pose_boxes = (
        np.array([instance.box for instance in members]).reshape(-1, 4)
        for members in (instances, poses)
    )
    overlaps = box_ious(boxes, pose_boxes)
    # A sure pose outweighs every overlap; pairs below the threshold displace none.
    worth = overlaps + [pose.confidence > sure for pose in poses]
    worth[overlaps < _SAME_IOU] = 0.0
    out = list(instances)
    for i, j in zip(*linear_sum_assignment(worth, maximize=True), strict=True):
        if worth[i, j] > 0:
            ends = poses[j].end_confidence
            out[i] = replace(out[i], keypoints=poses[j].keypoints, end_confidence=ends)
    return tuple(out)


@dataclass(frozen=True, eq=False)
class _Region:
    """An instance with its mask, the mask's window, and the pixels in it."""

    instance: Instance
    mask: Mask | None
    window: tuple[slice, slice] | None
    area: float

    @classmethod
    def of(cls, instance: Instance) -> _Region:
        mask = visible_mask(instance)
        window = None if mask is None else mask_window(mask)
        if mask is None or window is None:
            return cls(instance, None, None, float(box_areas(instance.box[None])[0]))
        return cls(instance, mask, window, float(np.count_nonzero(mask[window])))


def visible_mask(instance: Instance) -> Mask | None:
    """Return the detector's own mask, or the measured mask without one."""
    return instance.mask if instance.detector_mask is None else instance.detector_mask


def _best_first(region: _Region) -> tuple[float, float]:
    return -region.instance.confidence, -region.area


def _shared(a: _Region, b: _Region) -> float:
    """Return the number of shared pixels of two masks, or the overlap of boxes without masks."""
    if a.mask is None or b.mask is None or a.window is None or b.window is None:
        return box_iou(a.instance.box, b.instance.box)
    both = overlap(a.window, b.window)
    return float(np.count_nonzero(a.mask[both] & b.mask[both]))


def _same(a: _Region, b: _Region) -> bool:
    if a.mask is None or b.mask is None:
        return box_iou(a.instance.box, b.instance.box) >= _SAME_BOX_IOU
    shared = _shared(a, b)
    return shared >= min(_SAME_IOU * (a.area + b.area - shared), _INSIDE * min(a.area, b.area))


def _around_several(region: _Region, regions: Sequence[_Region]) -> bool:
    """Return whether an instance is a box around several fruit that were also found separately."""
    if region.mask is None:
        return False
    parts: list[_Region] = []
    for inner in regions:
        # An instance that matches the whole is a duplicate, not a part.
        if inner is region or inner.mask is None or inner.area >= region.area:
            continue
        shared = _shared(region, inner)
        if shared >= _INSIDE * inner.area and not any(_same(inner, part) for part in parts):
            parts.append(inner)
    if len(parts) < 2:
        return False
    return float(np.mean([part.instance.confidence for part in parts])) > region.instance.confidence


def _merged_instance(group: Sequence[_Region]) -> Instance:
    members = sorted(group, key=_best_first)
    best = members[0].instance.confidence
    trusted = [region for region in members if region.instance.confidence >= TRUSTED_SHARE * best]
    instance = max(trusted, key=lambda region: region.area).instance
    candidates = (instance, *(member.instance for member in members))
    posed = next((x for x in candidates if x.keypoints is not None), instance)
    points, ends = posed.keypoints, posed.end_confidence
    return replace(instance, confidence=best, keypoints=points, end_confidence=ends)
