"""One fruit in the picture: box, masks and keypoints, and where each came from."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["KEYPOINT_NAMES", "SKELETON", "Instance", "MaskSource"]

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
        """Who that is, for people."""
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
