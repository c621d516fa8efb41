"""One fruit in the picture: box, masks and keypoints, and where each came from."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "KEYPOINT_NAMES",
    "SKELETON",
    "Instance",
    "MaskSource",
    "box_iou",
    "box_of_mask",
    "mask_iou",
]

KEYPOINT_NAMES = ("blossom_end", "quarter", "middle", "three_quarters", "stem_end")
"""The five landmarks along a fruit, in the order in which they are stored."""

SKELETON = ((0, 1), (1, 2), (2, 3), (3, 4))
"""Pairs of landmarks that a line joins."""


class MaskSource(StrEnum):
    """Who drew a mask."""

    SAM = "sam"
    DETECTOR = "detector"
    DATASET = "dataset"


@dataclass(frozen=True, eq=False)
class Instance:
    """One detected fruit.

    Parameters
    ----------
    box : ndarray of float64, shape (4,)
        x1, y1, x2, y2 of the box's edges in pixels; a mask's box runs from half a pixel outside
        its first pixel centre to half a pixel outside its last.
    confidence : float
        The detector's confidence, 0 to 1; 1 for boxes and masks given by people.
    class_name : str
        Class name.
    mask : ndarray of bool, shape (H, W), optional
        The mask to measure: SAM's or the data set's own.
    mask_source : MaskSource, optional
        Who drew `mask`.
    detector_mask : ndarray of bool, shape (H, W), optional
        The detector's own mask, which `best` falls back on.
    keypoints : ndarray of float64, shape (5, 3), optional
        u, v in pixels and visibility 0 to 1 of KP0 (blossom end) to KP4 (stem end).
    mask_failure : str
        Why SAM's mask was refused ('mask-empty', 'mask-small', 'mask-off-box',
        'mask-off-detector'); empty if not.
    end_confidence : float, optional
        How probable it is that `keypoints` run from blossom to stem and not the other way; None
        where the pose network itself is said to know.
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


def box_of_mask(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Give the edges x1, y1, x2, y2 of a mask's box, in pixels.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        At least one pixel set.

    Raises
    ------
    ValueError
        If no pixel is set.

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1, 2:5] = True
    >>> box_of_mask(mask).tolist()
    [1.5, 0.5, 4.5, 1.5]
    """
    ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(ys):
        raise ValueError("the mask is empty")
    return np.array([xs[0] - 0.5, ys[0] - 0.5, xs[-1] + 0.5, ys[-1] + 0.5])


def box_iou(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Give the intersection over union of two boxes x1, y1, x2, y2.

    Examples
    --------
    >>> box_iou(np.array([0.0, 0, 2, 1]), np.array([1.0, 0, 3, 1])) == 1 / 3
    True
    """
    w = min(a[2], b[2]) - max(a[0], b[0])
    h = min(a[3], b[3]) - max(a[1], b[1])
    if w <= 0 or h <= 0:
        return 0.0
    area = [(x[2] - x[0]) * (x[3] - x[1]) for x in (a, b)]
    return float(w * h / (area[0] + area[1] - w * h))


def mask_iou(a: NDArray[np.bool_] | None, b: NDArray[np.bool_]) -> float:
    """Give two masks' intersection over union; 0 where there is no first one.

    Examples
    --------
    >>> mask_iou(np.array([[True, True, False]]), np.array([[False, True, True]])) == 1 / 3
    True
    """
    if a is None:
        return 0.0
    union = np.count_nonzero(a | b)
    return float(np.count_nonzero(a & b) / union) if union else 0.0
