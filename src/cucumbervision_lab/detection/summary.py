"""All figures of an evaluation, computed once: for the screen, the tables and the page."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.accuracy.tables import Truth
from cucumbervision_lab.detection.average_precision import (
    AveragePrecision,
    Judged,
    average_precision,
)
from cucumbervision_lab.detection.estimates import Estimate, estimate, share
from cucumbervision_lab.detection.groups import GroupScore, group_scores, overall
from cucumbervision_lab.detection.lengths import LengthScore, length_scores
from cucumbervision_lab.detection.outcomes import (
    EndRow,
    FoundRow,
    FruitRow,
    end_rows,
    found_rows,
    fruit_rows,
)
from cucumbervision_lab.detection.pictures import Stage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision_lab.detection.overlaps import OverlapRow
    from cucumbervision_lab.detection.run import DetectionResult

__all__ = ["EndScore", "OverlapScore", "Precision", "Summary", "summarise"]


@dataclass(frozen=True)
class Precision:
    """Average precision of one network's boxes, masks or keypoints."""

    stage: Stage
    judged: Judged
    found: AveragePrecision


@dataclass(frozen=True)
class EndScore:
    """How well ends are set.

    Parameters
    ----------
    ends : str
        Which ends: 'all', 'in sight', 'hidden', 'blossom end', 'stem end'.
    median_percent, p90_percent : Estimate
        Error in percent of the fruit's length in the picture.
    """

    ends: str
    median_percent: Estimate
    p90_percent: Estimate


@dataclass(frozen=True)
class OverlapScore:
    """How well one kind of mask agrees with the true ones.

    Parameters
    ----------
    pictures : str
        'drawn' or 'real'.
    prompt_box : str
        'found' or 'true'.
    masks : str
        'network alone', 'SAM, box', 'SAM, box + centre', or 'what is measured': the last, or the
        network's where SAM's was refused.
    mean, median : Estimate
        Intersection over union, a refused mask of SAM counting as 0.
    refused : int
        How many were refused.
    """

    pictures: str
    prompt_box: str
    masks: str
    mean: Estimate
    median: Estimate
    refused: int


@dataclass(frozen=True, eq=False)
class Summary:
    """Every figure.

    Parameters
    ----------
    precisions : tuple of Precision
        COCO's.
    overall : tuple of (Stage, GroupScore)
        Recall and precision at the confidence.
    groups : tuple of GroupScore
        The same of what is reported, by groups.
    ends : tuple of EndScore
        Endpoint errors.
    swapped : Estimate
        Share of fruit whose ends are swapped.
    overlaps : tuple of OverlapScore
        Masks.
    lengths : tuple of LengthScore
        Against centreline and thread.
    fruit, found, end_rows : tuple
        What the figures are of.
    """

    precisions: tuple[Precision, ...]
    overall: tuple[tuple[Stage, GroupScore], ...]
    groups: tuple[GroupScore, ...]
    ends: tuple[EndScore, ...]
    swapped: Estimate
    overlaps: tuple[OverlapScore, ...]
    lengths: tuple[LengthScore, ...]
    fruit: tuple[FruitRow, ...]
    found: tuple[FoundRow, ...]
    end_rows: tuple[EndRow, ...]


def summarise(result: DetectionResult) -> Summary:
    """Compute every figure of an evaluation.

    Parameters
    ----------
    result : DetectionResult
        From `evaluate_detection`.
    """
    frames, confidence = result.frames, result.plan.confidence
    stages = {str(model.get("task", "")) for model in result.models}
    segmented, posed = bool(stages & {"segment", "detect"}), "pose" in stages
    asked = [(Stage.SEGMENTED, Judged.BOXES)] if segmented else []
    asked += [(Stage.SEGMENTED, Judged.MASKS)] if "segment" in stages else []
    asked += [(Stage.POSED, Judged.BOXES), (Stage.POSED, Judged.KEYPOINTS)] if posed else []
    fruit, found = fruit_rows(frames, confidence), found_rows(frames, confidence)
    parts = [Stage.KEPT, *dict.fromkeys(stage for stage, _ in asked)]
    ends = end_rows(frames, confidence)
    turned = [(row.swapped, row.scene) for row in ends if row.swapped is not None]
    return Summary(
        tuple(Precision(s, j, average_precision(frames, j, s)) for s, j in asked),
        tuple(
            (s, overall(fruit_rows(frames, confidence, s), found_rows(frames, confidence, s)))
            for s in parts
        ),
        tuple(group_scores(fruit, found)),
        tuple(_end_scores(ends)),
        share([swapped for swapped, _ in turned], [scene for _, scene in turned]),
        tuple(_overlap_scores(result.overlaps)),
        tuple(
            score
            for truth in (Truth.CENTRELINE, Truth.THREAD)
            for score in length_scores(result.records, truth)
        ),
        tuple(fruit),
        tuple(found),
        tuple(ends),
    )


def _end_scores(rows: Sequence[EndRow]) -> list[EndScore]:
    ends = [(r.blossom_percent, r.scene, r.blossom_seen, "blossom end") for r in rows]
    ends += [(r.stem_percent, r.scene, r.stem_seen, "stem end") for r in rows]
    ends = [end for end in ends if math.isfinite(end[0])]
    groups = {
        "all": ends,
        "in sight": [end for end in ends if end[2]],
        "hidden": [end for end in ends if not end[2]],
        "blossom end": [end for end in ends if end[3] == "blossom end"],
        "stem end": [end for end in ends if end[3] == "stem end"],
    }
    scores = []
    for name, some in groups.items():
        values, scenes = [end[0] for end in some], [end[1] for end in some]
        if some:
            scores.append(
                EndScore(name, estimate(values, scenes, 0.5), estimate(values, scenes, 0.9))
            )
    return scores


def _overlap_scores(rows: Sequence[OverlapRow]) -> list[OverlapScore]:
    scores = []
    for pictures in ("drawn", "real"):
        some = [r for r in rows if r.simulated == (pictures == "drawn")]
        for prompt in sorted({r.prompt_box for r in some}):
            same = [r for r in some if r.prompt_box == prompt]
            kinds = {
                "network alone": ([r.network_iou for r in same], 0),
                "SAM, box": ([r.box_iou for r in same], sum(bool(r.box_refused) for r in same)),
                "SAM, box + centre": (
                    [r.point_iou for r in same],
                    sum(bool(r.point_refused) for r in same),
                ),
                "what is measured": ([r.used_iou for r in same], 0),
            }
            for name, (values, refused) in kinds.items():
                known = np.isfinite(values)
                scenes = [r.scene for r, k in zip(same, known, strict=True) if k]
                data = np.array(values)[known]
                if data.size:
                    mean, median = estimate(data, scenes), estimate(data, scenes, 0.5)
                    scores.append(OverlapScore(pictures, prompt, name, mean, median, refused))
    return scores
