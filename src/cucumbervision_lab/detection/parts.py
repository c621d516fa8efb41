"""Fruit that something hides in the middle, masks over two fruit, and pixels in two masks."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.perception.mask_codes import decode_rle
from cucumbervision_lab.detection.pictures import Stage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision_lab.detection.pictures import Code, Frame

_LEAST_PX, _LEAST_SHARE = 80, 0.05  # of a fruit's mask, what counts as a part of it
_HOLDS = 0.5  # share of a part in a find's mask
_OF_FIND, _OF_FRUIT = 0.2, 0.3  # of a find and of a fruit: from here on a find is of that fruit too


class _Outcome(StrEnum):
    WHOLE, PIECES, PART, MISSED = "whole", "pieces", "part", "missed"


@dataclass(frozen=True)
class PartScore:
    """How fruit in parts, and neighbours, were detected at one stage.

    Parameters
    ----------
    stage : Stage
        Whose finds.
    in_parts : int
        Fruit to be found whose visible mask has two or more parts.
    whole, pieces, part, missed : int
        Of them, those that one find holds with two parts or more; that several finds hold, each a
        part; of which one part was found; of which none was.
    finds : int
        Finds with a mask.
    over_two : int
        Of them, those that lie over two fruit: parts joined wrongly, or a neighbour swallowed.
    shared_percent : float
        Pixels in the masks of two finds, in percent of those in any.
    """

    stage: Stage
    in_parts: int
    whole: int
    pieces: int
    part: int
    missed: int
    finds: int
    over_two: int
    shared_percent: float


def parts_of(mask: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Return a mask's parts of at least 80 pixels and 5 % of it.

    Examples
    --------
    >>> mask = np.zeros((20, 60), bool)
    >>> mask[:, :20] = mask[:, 30:50] = mask[0, 55] = True
    >>> [int(part.sum()) for part in parts_of(mask)]
    [400, 400]
    """
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    areas = np.asarray(stats)[:, cv2.CC_STAT_AREA]
    least = max(_LEAST_PX, _LEAST_SHARE * areas[1:].sum())
    return [np.asarray(labels) == k for k in range(1, count) if areas[k] >= least]


def score_parts(frames: Sequence[Frame], confidence: float, stage: Stage) -> PartScore:
    """Count detected and missed fruit in parts, detections over two fruit, and pixels in two masks.

    Parameters
    ----------
    frames : sequence of Frame
        With coded masks; fruit and finds without are left out.
    confidence : float
        A find's score must exceed it.
    stage : Stage
        Whose finds are judged.

    Examples
    --------
    >>> from cucumbervision_lab.detection.pictures import Frame, FoundFruit, TrueFruit, code_mask
    >>> box, mask = np.array([0.0, 0, 50, 20]), np.zeros((20, 60), bool)
    >>> mask[:, :20] = mask[:, 30:50] = True
    >>> seen = tuple(FoundFruit(box, 0.9, code_mask(part)) for part in parts_of(mask))
    >>> frame = Frame("a", "a", 60, 20, (TrueFruit(box, code_mask(mask)),), kept=seen)
    >>> one = score_parts([frame], 0.3, Stage.KEPT)
    >>> one.in_parts, one.whole, one.pieces, one.finds, one.over_two
    (1, 0, 1, 2, 0)
    """
    outcomes: list[_Outcome] = []
    finds = over_two = shared = covered = 0
    for frame in frames:
        seen = [_mask(s.code) for s in frame.seen(stage) if s.score > confidence and s.code]
        true = [_mask(fruit.code) for fruit in frame.true if fruit.code and fruit.required]
        finds += len(seen)
        over_two += sum(_over_two(one, true) for one in seen)
        if seen:
            # One picture's finds are few: bytes hold how many lie on a pixel.
            deep = np.sum(seen, axis=0, dtype=np.uint8)
            shared += int(np.count_nonzero(deep > 1))
            covered += int(np.count_nonzero(deep))
        for fruit in true:
            parts = parts_of(fruit)
            if len(parts) > 1:
                outcomes.append(_outcome(parts, seen))
    return PartScore(
        stage,
        len(outcomes),
        outcomes.count(_Outcome.WHOLE),
        outcomes.count(_Outcome.PIECES),
        outcomes.count(_Outcome.PART),
        outcomes.count(_Outcome.MISSED),
        finds,
        over_two,
        100 * shared / max(covered, 1),
    )


def _mask(code: Code) -> NDArray[np.bool_]:
    return decode_rle(code["counts"], *code["size"])


def _over_two(find: NDArray[np.bool_], fruit: Sequence[NDArray[np.bool_]]) -> bool:
    area = np.count_nonzero(find)
    shared = [(np.count_nonzero(find & one), np.count_nonzero(one)) for one in fruit]
    held = [both for both, own in shared if both >= max(_OF_FIND * area, _OF_FRUIT * own)]
    return len(held) > 1


def _outcome(parts: Sequence[NDArray[np.bool_]], seen: Sequence[NDArray[np.bool_]]) -> _Outcome:
    held = [
        len([1 for part in parts if np.count_nonzero(part & one) >= _HOLDS * part.sum()])
        for one in seen
    ]
    if max(held, default=0) > 1:
        return _Outcome.WHOLE
    number = len([count for count in held if count])
    return (_Outcome.MISSED, _Outcome.PART, _Outcome.PIECES)[min(number, 2)]
