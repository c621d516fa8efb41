"""One labelled picture, its true fruit and what the networks found in it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.errors import MissingExtraError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.perception.instances import Instance

__all__ = [
    "Code",
    "Frame",
    "SeenFruit",
    "Stage",
    "TrueFruit",
    "code_mask",
    "code_overlap",
    "import_pycocotools",
    "seen_fruit",
]

Code = dict[str, Any]
"""A mask as pycocotools keeps it: `size` (H, W) and compressed run lengths."""


def import_pycocotools() -> Any:
    """Import pycocotools' masks.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    try:
        from pycocotools import mask
    except ImportError:
        raise MissingExtraError("pycocotools", "benchmark") from None
    return mask


class Stage(StrEnum):
    """Whose detections are judged."""

    SEGMENTED = "segmenting network"
    POSED = "pose network"
    KEPT = "what is reported"


@dataclass(frozen=True, eq=False)
class TrueFruit:
    """A fruit that is truly there, or a region that is not to be judged.

    Parameters
    ----------
    box : ndarray of float64, shape (4,)
        Edges x1, y1, x2, y2 of what shows of it, pixels.
    code : dict, optional
        The mask of what shows, coded.
    keypoints : ndarray of float64, shape (5, 3), optional
        u, v in pixels and COCO's visibility: 2 seen, 1 hidden, 0 not labelled or outside the
        picture (0, 0 where its place is not known).
    ignore : bool
        True for regions that are not to be judged.
    optional : bool
        True for what may be found, once, but need not be: a zucchini.
    hidden_share : float
        Share of its outline that something hides, 0 to 1; NaN where unknown.
    cut_off : bool, optional
        Whether the picture's border cuts it; None where unknown.
    distance_m : float
        Distance of its middle along the view, metres; NaN where unknown.
    centreline_m, thread_m, chord_m : float, optional
        True lengths, metres.
    """

    box: NDArray[np.float64]
    code: Code | None = None
    keypoints: NDArray[np.float64] | None = None
    ignore: bool = False
    optional: bool = False
    hidden_share: float = math.nan
    cut_off: bool | None = None
    distance_m: float = math.nan
    centreline_m: float | None = None
    thread_m: float | None = None
    chord_m: float | None = None

    @property
    def required(self) -> bool:
        """Whether it is to be found."""
        return not (self.ignore or self.optional)

    @property
    def long_px(self) -> float:
        """The longer side of its box, pixels."""
        return float(max(self.box[2] - self.box[0], self.box[3] - self.box[1]))


@dataclass(frozen=True, eq=False)
class SeenFruit:
    """What a network found.

    Parameters
    ----------
    box : ndarray of float64, shape (4,)
        Edges, pixels.
    score : float
        Its confidence.
    code : dict, optional
        Its mask, coded.
    keypoints : ndarray of float64, shape (5, 3), optional
        u, v in pixels and visibility 0 to 1.
    distance_m : float
        Distance along the view of what is in the middle of the box; NaN where unknown.
    """

    box: NDArray[np.float64]
    score: float
    code: Code | None = None
    keypoints: NDArray[np.float64] | None = None
    distance_m: float = math.nan

    @property
    def long_px(self) -> float:
        """The longer side of its box, pixels."""
        return float(max(self.box[2] - self.box[0], self.box[3] - self.box[1]))


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of the test.

    Parameters
    ----------
    name : str
        Its file's name, unique within the set.
    scene : str
        Pictures of one scene are no independent samples.
    width, height : int
        Its size, pixels.
    true : tuple of TrueFruit
        What is there.
    segmented, posed : tuple of SeenFruit
        What the two networks found, best first, whatever the confidence.
    kept : tuple of SeenFruit
        What a user gets at the confidence that is judged: fruit found twice made one.
    has_masks : bool
        Whether the first network draws masks at all.
    """

    name: str
    scene: str
    width: int
    height: int
    true: tuple[TrueFruit, ...] = ()
    segmented: tuple[SeenFruit, ...] = ()
    posed: tuple[SeenFruit, ...] = ()
    kept: tuple[SeenFruit, ...] = ()
    has_masks: bool = True

    def seen(self, stage: Stage) -> tuple[SeenFruit, ...]:
        """Give the detections of one stage."""
        return {
            Stage.SEGMENTED: self.segmented,
            Stage.POSED: self.posed,
            Stage.KEPT: self.kept,
        }[stage]


def code_mask(mask: NDArray[np.bool_]) -> Code:
    """Code a mask of shape (H, W).

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1:3, 2:5] = True
    >>> code = code_mask(mask)
    >>> code["size"], code_overlap(code, code)
    ([4, 6], 1.0)
    """
    code: Code = import_pycocotools().encode(np.asfortranarray(mask, np.uint8))
    return code


def code_overlap(a: Code | None, b: Code | None) -> float:
    """Give the intersection over union of two coded masks; 0 where one is missing or empty."""
    if a is None or b is None:
        return 0.0
    return float(import_pycocotools().iou([a], [b], [0])[0, 0])


def seen_fruit(instance: Instance, depth_m: NDArray[np.float32] | None = None) -> SeenFruit:
    """Keep what is judged of a detection, its mask coded (a full one takes a megabyte).

    Parameters
    ----------
    instance : Instance
        From a network.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres, to tell its distance by: the median reading in the middle ninth of the box.
    """
    mask = instance.detector_mask
    code = None if mask is None else code_mask(mask)
    distance = math.nan if depth_m is None else _middle_depth(instance.box, depth_m)
    return SeenFruit(instance.box, instance.confidence, code, instance.keypoints, distance)


def _middle_depth(box: NDArray[np.float64], depth_m: NDArray[np.float32]) -> float:
    x1, y1, x2, y2 = box
    left, right = np.rint([(2 * x1 + x2) / 3, (x1 + 2 * x2) / 3]).astype(int)
    top, bottom = np.rint([(2 * y1 + y2) / 3, (y1 + 2 * y2) / 3]).astype(int)
    part = depth_m[max(top, 0) : bottom + 1, max(left, 0) : right + 1]
    read = part[valid_depth(part)]
    return float(np.median(read)) if read.size else math.nan
