"""Who is who: detections against what is truly there, at one confidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.perception.boxes import box_ious, share_inside

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["IN_IGNORED", "MIN_IOU", "Matches", "match_boxes"]

MIN_IOU = 0.5
IN_IGNORED = 0.5
"""A detection of which at least this share lies in regions not to be judged is not counted."""


@dataclass(frozen=True)
class Matches:
    """What became of the detections and of the true fruit of one picture.

    Parameters
    ----------
    pairs : tuple of (int, int)
        True fruit and the detection that hit it.
    missed : tuple of int
        True fruit that nothing hit.
    false : tuple of int
        Detections that hit nothing.
    neutral : tuple of int
        Detections that are neither right nor wrong.
    """

    pairs: tuple[tuple[int, int], ...]
    missed: tuple[int, ...]
    false: tuple[int, ...]
    neutral: tuple[int, ...]


def match_boxes(
    found: ArrayLike,
    required: ArrayLike,
    optional: ArrayLike = (),
    ignored: ArrayLike = (),
) -> Matches:
    """Match detections one to one with true boxes, best detection first, as COCO does.

    Parameters
    ----------
    found : array_like of float, shape (N, 4)
        Detections x1, y1, x2, y2, best first.
    required : array_like of float, shape (M, 4)
        True boxes that are to be found.
    optional : array_like of float, shape (K, 4)
        Boxes that may be found, once each.
    ignored : array_like of float, shape (L, 4)
        Regions in which nothing is judged.

    Returns
    -------
    Matches
        A hit has an IoU of at least 0.5. A detection without a hit is neutral where at least half
        of its area lies in ignored regions, otherwise false.

    Examples
    --------
    >>> found = [[0, 0, 10, 40], [1, 0, 11, 40], [50, 50, 60, 60], [90, 90, 99, 99]]
    >>> match_boxes(found, [[0, 0, 10, 40]], ignored=[[40, 40, 70, 70]])
    Matches(pairs=((0, 0),), missed=(), false=(1, 3), neutral=(2,))
    """
    boxes, needed, allowed = _boxes(found), _boxes(required), _boxes(optional)
    overlaps = box_ious(boxes, np.concatenate([needed, allowed]))
    inside = share_inside(boxes, _boxes(ignored))
    count, taken = len(needed), np.zeros(len(needed) + len(allowed), bool)
    pairs: list[tuple[int, int]] = []
    false: list[int] = []
    neutral: list[int] = []
    for k in range(len(boxes)):
        hit = _best(overlaps[k], taken, count)
        if hit is not None:
            taken[hit] = True
        if hit is not None and hit < count:
            pairs.append((hit, k))
        elif hit is not None or inside[k] >= IN_IGNORED:
            neutral.append(k)
        else:
            false.append(k)
    missed = tuple(np.flatnonzero(~taken[:count]).tolist())
    return Matches(tuple(sorted(pairs)), missed, tuple(false), tuple(neutral))


def _best(overlaps: NDArray[Any], taken: NDArray[np.bool_], required: int) -> int | None:
    """Give the free box with the largest overlap, those that are required first."""
    free = np.where(taken, 0.0, overlaps)
    for part, start in ((free[:required], 0), (free[required:], required)):
        if part.size and part.max() >= MIN_IOU:
            return start + int(part.argmax())
    return None


def _boxes(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, np.float64).reshape(-1, 4)
