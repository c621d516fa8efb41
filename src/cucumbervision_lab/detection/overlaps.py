"""Masks that SAM draws from a box, and from a box with its centre, against true masks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.perception.masks import mask_iou

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.perception.instances import Instance
    from cucumbervision.perception.sam import Segmenter

__all__ = [
    "PROMPTS_COMPARED",
    "OverlapRow",
    "capture_overlaps",
    "draw_by_prompt",
    "overlap_rows",
]

PROMPTS_COMPARED = ("box", "box+point")


@dataclass(frozen=True)
class OverlapRow:
    """How well each mask of one fruit agrees with the true one.

    Parameters
    ----------
    picture, scene : str
        Where it is.
    fruit : int
        Its number among the picture's labels, from 0.
    simulated : bool
        Whether the picture is drawn.
    prompt_box : str
        'found' (the detector's) or 'true' (the true mask's).
    network_iou : float
        Of the detector's own mask; NaN where it drew none.
    box_iou, point_iou : float
        Of SAM's mask from the box, and from box and centre; 0 where it was refused.
    used_iou : float
        Of the mask that is measured: SAM's by the shipped prompt, or the detector's own where
        SAM's was refused.
    box_refused, point_refused : str
        Why SAM's mask was refused; empty if it was not.
    """

    picture: str
    scene: str
    fruit: int
    simulated: bool
    prompt_box: str
    network_iou: float
    box_iou: float
    point_iou: float
    used_iou: float
    box_refused: str = ""
    point_refused: str = ""


def overlap_rows(
    where: tuple[str, str],
    pairs: Sequence[tuple[int, NDArray[np.bool_], Instance]],
    drawn: Mapping[str, Sequence[Instance]],
    *,
    simulated: bool = True,
    prompt_box: str = "found",
) -> list[OverlapRow]:
    """Compare every mask of a picture's fruit with the true one.

    Parameters
    ----------
    where : (str, str)
        The picture and its scene.
    pairs : sequence of (int, ndarray of bool, Instance)
        Each fruit's number, its true mask, and the instance whose box was the prompt.
    drawn : mapping of str to sequence of Instance
        By prompt ('box', 'box+point'): what SAM made of each instance, in the same order.
    simulated, prompt_box
        As `OverlapRow` says.
    """
    rows = []
    for place, (number, true, instance) in enumerate(pairs):
        own = instance.detector_mask
        by_box, by_point = (drawn[prompt][place] for prompt in PROMPTS_COMPARED)
        rows.append(
            OverlapRow(
                *where,
                number,
                simulated,
                prompt_box,
                math.nan if own is None else mask_iou(own, true),
                mask_iou(by_box.mask, true),
                mask_iou(by_point.mask, true),
                mask_iou(own if by_point.mask is None else by_point.mask, true),
                by_box.mask_failure,
                by_point.mask_failure,
            )
        )
    return rows


def draw_by_prompt(
    segmenter: Segmenter, color: NDArray[np.uint8], asked: Sequence[Instance]
) -> dict[str, tuple[Instance, ...]]:
    """Return SAM's masks of every fruit by each of `PROMPTS_COMPARED`, the shipped one last."""
    drawn = {}
    for prompt in PROMPTS_COMPARED:
        segmenter.prompt = prompt
        drawn[prompt] = segmenter.segment(color, asked)
    return drawn


def capture_overlaps(capture: Capture, segmenter: Segmenter, scene: str) -> list[OverlapRow]:
    """Prompt SAM by the boxes of a capture's own true masks.

    Parameters
    ----------
    capture : Capture
        With masks.
    segmenter : Segmenter
        SAM.
    scene : str
        What its near-duplicates share.
    """
    from cucumbervision.pipeline.finders import dataset_instances

    true = dataset_instances(capture)
    asked = [replace(one, mask=None, mask_source=None) for one in true]
    drawn = draw_by_prompt(segmenter, capture.color, asked)
    pairs = [(k, one.mask, asked[k]) for k, one in enumerate(true) if one.mask is not None]
    return overlap_rows(
        (capture.name, scene), pairs, drawn, simulated=capture.simulated, prompt_box="true"
    )
