"""All figures of an evaluation, computed once, and the tables that show them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import pandas as pd

from cucumbervision.accuracy.statistics import Estimate, estimate, share
from cucumbervision.accuracy.table import Cell, Table
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_lab.detection.average_precision import (
    OKS_SIGMA,
    AveragePrecision,
    Judged,
    average_precision,
)
from cucumbervision_lab.detection.lengths import LengthScore, length_scores
from cucumbervision_lab.detection.outcomes import (
    EndRow,
    FoundRow,
    FruitRow,
    GroupScore,
    end_rows,
    found_rows,
    fruit_rows,
    group_scores,
    overall,
)
from cucumbervision_lab.detection.parts import PartScore, score_parts
from cucumbervision_lab.detection.pictures import Stage
from cucumbervision_lab.report.length_tables import DESCRIPTIONS
from cucumbervision_lab.report.records import Masks, readings_frame

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision_lab.detection.photos import PhotoResult
    from cucumbervision_lab.detection.picture_result import OverlapRow
    from cucumbervision_lab.detection.run import DetectionResult
    from cucumbervision_lab.report.records import LengthRecord


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
    box : str
        Whose box was the prompt: 'found' (the detector's) or 'true'.
    masks : str
        'network alone', 'SAM, box', 'SAM, box + centre', or 'what is measured': the last, or the
        network's where SAM's was refused.
    mean_iou, median_iou : Estimate
        Intersection over union, a refused mask of SAM counting as 0.
    refused : int
        How many were refused.
    """

    pictures: str
    box: str
    masks: str
    mean_iou: Estimate
    median_iou: Estimate
    refused: int


@dataclass(frozen=True, eq=False)
class Summary:
    """Every figure.

    Parameters
    ----------
    precisions : tuple of AveragePrecision
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
    parts : tuple of PartScore
        Fruit in parts and finds over two fruit, where there are masks: of the network alone, and
        of what is reported.
    fruit, found, end_rows : tuple
        What the figures are of.
    """

    precisions: tuple[AveragePrecision, ...]
    overall: tuple[tuple[Stage, GroupScore], ...]
    groups: tuple[GroupScore, ...]
    ends: tuple[EndScore, ...]
    swapped: Estimate
    overlaps: tuple[OverlapScore, ...]
    lengths: tuple[LengthScore, ...]
    parts: tuple[PartScore, ...]
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
    if posed:
        asked += [(Stage.POSED, Judged.BOXES), (Stage.POSED, Judged.KEYPOINTS)]
        asked += [(Stage.KEPT, Judged.KEYPOINTS)]
    fruit, found = fruit_rows(frames, confidence), found_rows(frames, confidence)
    parts = [Stage.KEPT, *dict.fromkeys(stage for stage, _ in asked)]
    ends = end_rows(frames, confidence)
    end_scores, swapped = score_ends(ends)
    return Summary(
        tuple(average_precision(frames, judged, stage) for stage, judged in asked),
        tuple(
            (s, overall(fruit_rows(frames, confidence, s), found_rows(frames, confidence, s)))
            for s in parts
        ),
        tuple(group_scores(fruit, found)),
        end_scores,
        swapped,
        tuple(_overlap_scores(result.overlaps)),
        tuple(_length_scores(result.records)),
        tuple(
            score_parts(frames, confidence, stage)
            for stage in ((Stage.SEGMENTED, Stage.KEPT) if "segment" in stages else ())
        ),
        tuple(fruit),
        tuple(found),
        tuple(ends),
    )


def _length_scores(records: Sequence[LengthRecord]) -> list[LengthScore]:
    if not records:
        return []
    readings = readings_frame(records)
    return [
        score
        for truth in (LengthDefinition.CENTRELINE, LengthDefinition.THREAD)
        for score in length_scores(readings, truth)
    ]


def score_ends(rows: Sequence[EndRow]) -> tuple[tuple[EndScore, ...], Estimate]:
    """Compute how far the ends are off, and how often they are swapped.

    Parameters
    ----------
    rows : sequence of EndRow
        From `end_rows`.

    Returns
    -------
    scores : tuple of EndScore
        Groups without any end are left out.
    swapped : Estimate
        Share of the fruit both of whose ends are known.
    """
    frame = pd.DataFrame(rows, columns=[one.name for one in fields(EndRow)])
    turned = frame[frame["swapped"].notna()]
    swapped = share(turned["swapped"], turned["scene"])
    ends = pd.concat(
        frame.rename(columns={f"{end}_percent": "percent", f"{end}_seen": "seen"})[
            ["percent", "seen", "scene"]
        ].assign(end=f"{end} end")
        for end in ("blossom", "stem")
    ).dropna(subset="percent")
    groups = {
        "all": ends,
        "in sight": ends[ends["seen"].astype(bool)],
        "hidden": ends[~ends["seen"].astype(bool)],
        "blossom end": ends[ends["end"] == "blossom end"],
        "stem end": ends[ends["end"] == "stem end"],
    }
    scores = []
    for name, some in groups.items():
        if len(some):
            median, p90 = (estimate(some["percent"], some["scene"], q) for q in (0.5, 0.9))
            scores.append(EndScore(name, median, p90))
    return tuple(scores), swapped


_MASK_COLUMNS = {
    "network alone": ("network_iou", None),
    "SAM, box": ("box_iou", "box_refused"),
    "SAM, box + centre": ("point_iou", "point_refused"),
    "what is measured": ("used_iou", None),
}


def _overlap_scores(rows: Sequence[OverlapRow]) -> list[OverlapScore]:
    scores = []
    frame = pd.DataFrame(rows)
    for (simulated, prompt), same in frame.groupby(["simulated", "prompt_box"]) if rows else ():
        for name, (column, refused) in _MASK_COLUMNS.items():
            known = same[same[column].notna()]
            if len(known):
                values, scenes = known[column], known["scene"]
                mean, median = estimate(values, scenes), estimate(values, scenes, 0.5)
                count = int((same[refused] != "").sum()) if refused else 0
                pictures = "drawn" if simulated else "real"
                scores.append(OverlapScore(pictures, str(prompt), name, mean, median, count))
    return sorted(scores, key=lambda one: one.pictures)


_JUDGED = {Judged.BOXES: "boxes", Judged.MASKS: "masks", Judged.KEYPOINTS: "keypoints"}

_MASKS = {Masks.EXACT: "true", Masks.PERCEIVED: "perceived"}

_FALSE_SHOWN = 60


def precision_table(summary: Summary) -> Table:
    """Return average precision as a table."""
    heads = ["network", "of", "fruit", "mAP50:.3", "95 %", "mAP50-95:.3", "95 % by scene"]
    rows = [
        (
            str(one.stage),
            _JUDGED[one.judged],
            one.map50.count,
            *_spanned(one.map50),
            *_spanned(one.map50_95),
        )
        for one in summary.precisions
    ]
    comment = (
        "Average precision by pycocotools, over all confidences. Keypoints: object keypoint "
        f"similarity with sigma {OKS_SIGMA:g} for all five, scaled by the visible mask's area."
    )
    return Table.of("Average precision", heads, rows, comment)


def overall_table(summary: Summary, confidence: float) -> Table:
    """Return recall and precision at the confidence, stage by stage."""
    comment = (
        f"At confidence {confidence:g}; a hit has a box IoU of at least 0.5. Detections in regions "
        f"to be ignored are not counted. '{Stage.KEPT}' has fruit found twice made one."
    )
    named = [(str(stage), one) for stage, one in summary.overall]
    return _share_table("Recall and precision", "stage", named, comment)


def group_table(summary: Summary, factor: str) -> Table:
    """Return one factor's groups as a table."""
    named = [(one.group, one) for one in summary.groups if one.factor == factor]
    return _share_table(f"By {factor}", "group", named)


def part_table(scores: Sequence[PartScore]) -> Table:
    """Return how fruit in parts and neighbours were detected, as a table."""
    heads = ["stage", "fruit in parts", "found whole", "in pieces", "one part", "missed"]
    heads += ["finds", "over two fruit", "pixels in two masks (%):.2"]
    rows = [(str(one.stage), *list(vars(one).values())[1:]) for one in scores]
    comment = (
        "Fruit whose visible mask has two or more parts, since something nearer lies across them: "
        "held by one find with two parts or more, or each part by a find of its own. A find over "
        "two fruit holds 30 % of each: parts joined wrongly, or a neighbour swallowed."
    )
    return Table.of("Fruit in parts, and neighbours", heads, rows, comment)


def end_table(ends: Sequence[EndScore], swapped: Estimate, title: str = "Ends") -> Table:
    """Return endpoint errors as a table."""
    heads = ["ends", "n", "scenes", "median (% of length)", "95 %"]
    heads += ["90th percentile (% of length)", "95 % by scene"]
    rows = [
        (one.ends, median.count, median.groups, *_spanned(median, 2), *_spanned(one.p90_percent, 2))
        for one in ends
        for median in (one.median_percent,)
    ]
    share = "–" if math.isnan(swapped.value) else f"{100 * swapped.value:.2f} %"
    comment = (
        "Distance between the true and the found end, in percent of the line through the fruit's "
        "five true keypoints in the picture; fruit that the pose network found. Ends swapped on "
        f"{share} of {swapped.count} fruit (95 % by scene: {span(swapped, 2, 100)}); swapped ends "
        "are judged as they are."
    )
    return Table.of(title, heads, rows, comment)


def overlap_table(summary: Summary) -> Table:
    """Return masks' overlaps as a table."""
    heads = ["pictures", "box of", "masks", "n", "scenes", "mean IoU:.4", "95 % by scene"]
    heads += ["median IoU:.4", "95 %", "refused"]
    rows = [
        (
            one.pictures,
            "detector" if one.box == "found" else "true mask",
            one.masks,
            *(
                one.mean_iou.count,
                one.mean_iou.groups,
                *_spanned(one.mean_iou),
                *_spanned(one.median_iou),
            ),
            one.refused,
        )
        for one in summary.overlaps
    ]
    comment = (
        "Intersection over union with the true visible mask, of fruit that were found. A mask that "
        "SAM's checks refused counts as 0; there the detector's own stands in when measuring."
    )
    return Table.of("Masks", heads, rows, comment)


def length_table(summary: Summary, truth: str, group: str) -> Table:
    """Return lengths on true and on perceived masks, for one group of fruit."""
    heads = ["method", "masks", "fruit", "missed", "measured (%):.1", "mean error (%)"]
    heads += ["95 % by scene", "of the measured (%)", "95 %", "median (%)", "bias (%):+.2"]
    heads.append("what it is")
    some = [one for one in summary.lengths if one.truth == truth and one.group == group]
    order = {method: k for k, method in enumerate(dict.fromkeys(one.method for one in some))}
    rows = [
        (
            *(one.method, _MASKS[one.masks], one.metrics.count, one.missed),
            100 * one.metrics.measured,
            *(*_spanned(one.error_percent, 2), *_spanned(one.error_of_measured_percent, 2)),
            *(one.metrics.median_percent, one.metrics.bias_percent),
            DESCRIPTIONS.get(one.method, ""),
        )
        for one in sorted(some, key=lambda one: (order[one.method], one.masks))
    ]
    comment = (
        "Absolute error of the length; a fruit that was missed or not measured counts as 100 %, "
        "and 'of the measured' leaves those out."
    )
    return Table.of(f"Length against the {truth}, {group} fruit", heads, rows, comment)


def photo_table(photos: PhotoResult) -> Table:
    """Return recall and precision on real photos as a table."""
    (_, whole), *settings = photos.scores
    named = [("all", whole)]
    named += [(f"test: {name}", one) for name, one in photos.tests]
    named += [(f"half size: {name}", one) for name, one in photos.small]
    named += [(f"where: {name}", one) for name, one in settings]
    comment = (
        f"At confidence {photos.confidence:g}, on scenes that were never trained on. Whole "
        "cucumbers are to be found; a courgette may be, once; anything else is false. Detections "
        "of which half lies in an ignored region are not counted. At half size each photo lies "
        "shrunk in the middle of a grey picture. "
        + f"{photos.photos} photos of {photos.scenes} scenes"
        + (f"; {photos.missing} of the audit's photos are missing." if photos.missing else ".")
    )
    return _share_table("Real photos", "photos", named, comment)


def photo_end_table(photos: PhotoResult) -> Table:
    """Return endpoint errors on real photos as a table, where the ends were read."""
    return end_table(*score_ends(photos.ends), "Ends on real photos")


def false_table(photos: PhotoResult) -> Table:
    """Return false detections on real photos by file and box, the surest first."""
    false = sorted((r for r in photos.found if r.outcome == "false"), key=lambda r: -r.score)
    rows = [
        (r.picture, r.scene, r.score, f"{r.x1:.0f}, {r.y1:.0f} to {r.x2:.0f}, {r.y2:.0f}")
        for r in false[:_FALSE_SHOWN]
    ]
    title = f"False detections on real photos ({len(false)})"
    heads = ["photo", "scene", "confidence:.3", "box (px)"]
    return Table.of(title, heads, rows, "The photos themselves are not shown.")


def span(one: Estimate, decimals: int = 3, scale: float = 1.0) -> str:
    """Return an interval as text.

    Examples
    --------
    >>> span(Estimate(0.9, 0.8512, 0.94, 10, 5)), span(Estimate(1.0, math.nan, math.nan, 4, 1))
    ('0.851 to 0.940', '–')
    """
    if math.isnan(one.low):
        return "–"
    return f"{scale * one.low:.{decimals}f} to {scale * one.high:.{decimals}f}"


def _spanned(one: Estimate, decimals: int = 3) -> tuple[float, str]:
    return one.value, span(one, decimals)


def _share_table(
    title: str, first: str, named: Sequence[tuple[str, GroupScore]], comment: str = ""
) -> Table:
    """Return recall and precision by name."""
    heads = [first, "fruit", "scenes", "recall:.3", "95 % by scene", "detections"]
    heads += ["scenes with some", "precision:.3", "95 % of it by scene"]
    rows = [(name, *_share_cells(one.recall), *_share_cells(one.precision)) for name, one in named]
    return Table.of(title, heads, rows, comment)


def _share_cells(one: Estimate | None) -> tuple[Cell, ...]:
    return (None, None, None, "–") if one is None else (one.count, one.groups, *_spanned(one))
