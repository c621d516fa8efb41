"""The evaluation's figures set out as tables, each with how many values it is of."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from cucumbervision.accuracy.records import Masks
from cucumbervision.accuracy.table import Cell, Column, Table
from cucumbervision.accuracy.tables import DESCRIPTIONS
from cucumbervision_lab.detection.average_precision import OKS_SIGMA, Judged
from cucumbervision_lab.detection.pictures import Stage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision_lab.detection.estimates import Estimate
    from cucumbervision_lab.detection.photos import PhotoResult
    from cucumbervision_lab.detection.summary import Summary

__all__ = [
    "end_table",
    "false_table",
    "group_table",
    "length_table",
    "overall_table",
    "overlap_table",
    "photo_table",
    "precision_table",
]

_JUDGED = {Judged.BOXES: "boxes", Judged.MASKS: "masks", Judged.KEYPOINTS: "keypoints"}
_MASKS = {Masks.EXACT: "true", Masks.PERCEIVED: "perceived"}
_FALSE_SHOWN = 60


def precision_table(summary: Summary) -> Table:
    """Set average precision out."""
    columns = (
        Column("network"),
        Column("of"),
        Column("fruit"),
        Column("mAP50", 3),
        Column("95 %"),
        Column("mAP50-95", 3),
        Column("95 % by scene"),
    )
    rows = tuple(
        (
            str(one.stage),
            _JUDGED[one.judged],
            one.found.at_50.count,
            one.found.at_50.value,
            span(one.found.at_50),
            one.found.at_50_95.value,
            span(one.found.at_50_95),
        )
        for one in summary.precisions
    )
    comment = (
        "Average precision by pycocotools, over all confidences. Keypoints: object keypoint "
        f"similarity with sigma {OKS_SIGMA:g} for all five, scaled by the visible mask's area."
    )
    return Table("Average precision", columns, rows, comment)


def overall_table(summary: Summary, confidence: float) -> Table:
    """Set recall and precision at the confidence out, stage by stage."""
    rows = tuple(
        (str(stage), *_estimate_cells(one.recall), *_estimate_cells(one.precision))
        for stage, one in summary.overall
    )
    comment = (
        f"At confidence {confidence:g}; a hit has a box IoU of at least 0.5. Detections in regions "
        f"to be ignored are not counted. '{Stage.KEPT}' has fruit found twice made one."
    )
    return Table("Recall and precision", _shares("stage"), rows, comment)


def group_table(summary: Summary, factor: str) -> Table:
    """Set one factor's groups out."""
    rows = tuple(
        (one.group, *_estimate_cells(one.recall), *_estimate_cells(one.precision))
        for one in summary.groups
        if one.factor == factor
    )
    return Table(f"By {factor}", _shares("group"), rows)


def end_table(summary: Summary) -> Table:
    """Set endpoint errors out."""
    columns = (
        Column("ends"),
        Column("n"),
        Column("scenes"),
        Column("median (% of length)"),
        Column("95 %"),
        Column("90th percentile (% of length)"),
        Column("95 % by scene"),
    )
    rows: list[tuple[Cell, ...]] = [
        (
            one.ends,
            one.median_percent.count,
            one.median_percent.scenes,
            one.median_percent.value,
            span(one.median_percent, 1, 2),
            one.p90_percent.value,
            span(one.p90_percent, 1, 2),
        )
        for one in summary.ends
    ]
    swapped = summary.swapped
    share = "–" if math.isnan(swapped.value) else f"{100 * swapped.value:.2f} %"
    comment = (
        "Distance between the true and the found end, in percent of the line through the fruit's "
        "five true keypoints in the picture; fruit that the pose network found. Ends swapped on "
        f"{share} of {swapped.count} fruit (95 % by scene: {span(swapped, 100, 2)}); swapped ends "
        "are judged as they are."
    )
    return Table("Ends", columns, tuple(rows), comment)


def overlap_table(summary: Summary) -> Table:
    """Set masks' overlaps out."""
    columns = (
        Column("pictures"),
        Column("box of"),
        Column("masks"),
        Column("n"),
        Column("scenes"),
        Column("mean IoU", 4),
        Column("95 % by scene"),
        Column("median IoU", 4),
        Column("95 %"),
        Column("refused"),
    )
    rows = tuple(
        (
            one.pictures,
            "detector" if one.prompt_box == "found" else "true mask",
            one.masks,
            one.mean.count,
            one.mean.scenes,
            one.mean.value,
            span(one.mean),
            one.median.value,
            span(one.median),
            one.refused,
        )
        for one in summary.overlaps
    )
    comment = (
        "Intersection over union with the true visible mask, of fruit that were found. A mask that "
        "SAM's checks refused counts as 0; there the detector's own stands in when measuring."
    )
    return Table("Masks", columns, rows, comment)


def length_table(summary: Summary, truth: str, group: str) -> Table:
    """Set lengths on true and on perceived masks out for one group of fruit."""
    columns = (
        Column("method"),
        Column("masks"),
        Column("fruit"),
        Column("missed"),
        Column("measured (%)", 1),
        Column("mean error (%)"),
        Column("95 % by scene"),
        Column("of the measured (%)"),
        Column("95 %"),
        Column("median (%)"),
        Column("bias (%)", 2, signed=True),
        Column("what it is"),
    )
    some = [one for one in summary.lengths if one.truth == truth and one.group == group]
    order = {method: k for k, method in enumerate(dict.fromkeys(one.method for one in some))}
    rows = tuple(
        (
            one.method,
            _MASKS[one.masks],
            one.metrics.count,
            one.missed,
            100 * one.metrics.measured,
            one.error_percent.value,
            span(one.error_percent, 1, 2),
            one.measured_percent.value,
            span(one.measured_percent, 1, 2),
            one.metrics.median_percent,
            one.metrics.bias_percent,
            DESCRIPTIONS.get(one.method, ""),
        )
        for one in sorted(some, key=lambda one: (order[one.method], one.masks))
    )
    comment = (
        "Absolute error of the length; a fruit that was missed or not measured counts as 100 %, "
        "and 'of the measured' leaves those out."
    )
    return Table(f"Length against the {truth}, {group} fruit", columns, rows, comment)


def photo_table(photos: PhotoResult) -> Table:
    """Set recall and precision on real photos out."""
    (_, whole), *settings = photos.scores
    named = [("all", whole)]
    named += [(f"test: {name}", one) for name, one in photos.tests]
    named += [(f"half size: {name}", one) for name, one in photos.small]
    named += [(f"where: {name}", one) for name, one in settings]
    rows = tuple(
        (name, *_estimate_cells(one.recall), *_estimate_cells(one.precision)) for name, one in named
    )
    comment = (
        f"At confidence {photos.confidence:g}, on scenes that were never trained on. Whole "
        "cucumbers are to be found; a courgette may be, once; anything else is false. Detections "
        "of which half lies in an ignored region are not counted. At half size each photo lies "
        "shrunk in the middle of a grey picture. "
        + f"{photos.photos} photos of {photos.scenes} scenes"
        + (f"; {photos.missing} of the audit's photos are missing." if photos.missing else ".")
    )
    return Table("Real photos", _shares("photos"), rows, comment)


def false_table(photos: PhotoResult) -> Table:
    """List false detections on real photos by file and box, the surest first."""
    columns = (
        Column("photo"),
        Column("scene"),
        Column("confidence", 3),
        Column("box (px)"),
    )
    false = sorted((r for r in photos.found if r.outcome == "false"), key=lambda r: -r.score)
    rows = tuple(
        (r.picture, r.scene, r.score, f"{r.x1:.0f}, {r.y1:.0f} to {r.x2:.0f}, {r.y2:.0f}")
        for r in false[:_FALSE_SHOWN]
    )
    title = f"False detections on real photos ({len(false)})"
    return Table(title, columns, rows, "The photos themselves are not shown.")


def span(one: Estimate, scale: float = 1.0, decimals: int = 3) -> str:
    """Give an interval as text.

    Examples
    --------
    >>> from cucumbervision_lab.detection.estimates import Estimate
    >>> span(Estimate(0.9, 0.8512, 0.94, 10, 5)), span(Estimate(1.0, math.nan, math.nan, 4, 1))
    ('0.851 to 0.940', '–')
    """
    if math.isnan(one.low):
        return "–"
    return f"{scale * one.low:.{decimals}f} to {scale * one.high:.{decimals}f}"


def _shares(first: str) -> tuple[Column, ...]:
    return (
        Column(first),
        Column("fruit"),
        Column("scenes"),
        Column("recall", 3),
        Column("95 % by scene"),
        Column("detections"),
        Column("scenes with some"),
        Column("precision", 3),
        Column("95 % of it by scene"),
    )


def _estimate_cells(one: Estimate | None) -> Sequence[Cell]:
    if one is None:
        return (None, None, None, "–")
    return (one.count, one.scenes, one.value, span(one))
