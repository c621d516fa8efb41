"""Summarise an evaluation as tables, and write them with all rows to files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, installed_versions
from cucumbervision.accuracy.statistics import Cell, Estimate, ReportTable, estimate, share
from cucumbervision.errors import wrap_os_errors
from cucumbervision.files import write_csv
from cucumbervision.fruit.instance import LEAST_END_CONFIDENCE
from cucumbervision.methods.result import LengthDefinition
from cucumbervision_lab.evaluate import benchmark_report, outcomes
from cucumbervision_lab.evaluate.measure_case import Masks
from cucumbervision_lab.evaluate.outcomes import Evaluation
from cucumbervision_lab.evaluate.pictures import Stage

_MOST_FALSE_SHOWN = 60
_NEAR_M = (0.4, 0.7)
_LENGTH_COLUMNS = (
    *("fruit", "scene", "masks", "method", "length_m", "centreline_m", "thread_m", "chord_m"),
    *("missed", "hidden_share", "cut_off", "distance_m", "selected"),
)


def detection_tables(result: Evaluation) -> list[ReportTable]:
    """Return the tables of the result of `evaluate_detection`."""
    frames, confidence = result.frames, result.networks.confidence
    stages = {str(model.get("task", "")) for model in result.networks.models}
    asked = [(Stage.SEGMENTED, outcomes.IouType.BOXES)] if stages & {"segment", "detect"} else []
    asked += [(Stage.SEGMENTED, outcomes.IouType.MASKS)] if "segment" in stages else []
    if "pose" in stages:
        asked += [(Stage.POSED, outcomes.IouType.BOXES), (Stage.POSED, outcomes.IouType.KEYPOINTS)]
        asked += [(Stage.KEPT, outcomes.IouType.KEYPOINTS)]
    comment = (
        f"At confidence {confidence:g}; a hit has a box IoU of at least 0.5. Detections in regions "
        f"to be ignored are not counted. '{Stage.KEPT}' has duplicates merged."
    )
    by_stage = [
        (
            str(s),
            outcomes.overall(
                outcomes.fruit_rows(frames, confidence, s),
                outcomes.detection_rows(frames, confidence, s),
            ),
        )
        for s in (Stage.KEPT, *dict.fromkeys(stage for stage, _ in asked))
    ]
    precisions = [
        (str(stage), kind.name.lower(), *outcomes.average_precision(frames, kind, stage))
        for stage, kind in asked
    ]
    tables = [
        ReportTable.of(
            "Average precision",
            ["network", "of", "fruit", "mAP50:.3", "mAP50-95:.3"],
            precisions,
            "Average precision by pycocotools, over all confidences. Keypoints: object keypoint "
            f"similarity with sigma {outcomes.OKS_SIGMA:g} for all five, scaled by the area of the "
            "visible mask.",
        )
    ]
    tables += [_share_table("Recall and precision", "stage", by_stage, comment)]
    fruit, detections = (
        outcomes.fruit_rows(frames, confidence),
        outcomes.detection_rows(frames, confidence),
    )
    groups = list(outcomes.group_scores(fruit, detections))
    for factor in dict.fromkeys(factor for factor, _, _ in groups):
        named = [(group, score) for of_factor, group, score in groups if of_factor == factor]
        tables.append(_share_table(f"By {factor}", "group", named))
    ends = outcomes.end_rows(frames, confidence)
    tables += [end_table(ends)] if len(ends) else []
    readings = result.readings
    masks = _mask_table(fruit, readings)
    tables += [masks] if masks.rows else []
    if "swapped" in readings:
        tables.append(pose_table(readings))
    return tables + (_length_tables(readings) if len(readings) else [])


def _mask_table(fruit: pd.DataFrame, readings: pd.DataFrame) -> ReportTable:
    """Return the overlap of predicted with true visible masks."""
    kinds = {"detector": fruit}
    if "mask_iou" in readings:
        measured = readings.drop_duplicates(["case", "masks"])
        kinds["measured"] = measured[measured["masks"] == Masks.PERCEIVED]
    rows: list[tuple[Cell, ...]] = []
    for name, part in kinds.items():
        part = part.dropna(subset="mask_iou")
        if len(part):
            mean, median = (
                estimate(part["mask_iou"], part["scene"].tolist(), *q) for q in ((), (0.5,))
            )
            rows.append((name, mean.count, mean.groups, *_spanned(mean), *_spanned(median)))
    heads = ["masks", "fruit", "scenes", "mean IoU:.3", "95 % by scene", "median IoU:.3", "95 %"]
    comment = "Intersection over union with the true visible mask, of fruit that were found."
    return ReportTable.of("Masks", heads, rows, comment)


def _length_tables(readings: pd.DataFrame) -> list[ReportTable]:
    """Return the accuracy of lengths on true and on predicted masks, overall and by group."""
    tables = []
    for masks, words in ((Masks.EXACT, "true masks"), (Masks.PERCEIVED, "perceived masks")):
        of_masks = readings[readings["masks"] == masks]
        of_parts = [
            benchmark_report.accuracy_table(of_masks, LengthDefinition.CENTRELINE),
            benchmark_report.accuracy_table(of_masks, LengthDefinition.THREAD),
        ]
        if masks is Masks.PERCEIVED:
            scored = benchmark_report.comparable_readings(of_masks, LengthDefinition.CENTRELINE)
            of_parts += benchmark_report.group_tables(scored, LengthDefinition.CENTRELINE)
        tables += [replace(table, title=f"{table.title}, {words}") for table in of_parts]
    return tables


def end_table(frame: pd.DataFrame, title: str = "Ends") -> ReportTable:
    """Return the errors of the ends of `end_rows`, and the share of swapped ends."""
    turned = frame[frame["swapped"].notna()]
    swapped = share(turned["swapped"], turned["scene"])
    ends = pd.concat(
        frame.rename(columns={f"{end}_percent": "percent", f"{end}_seen": "seen"})[
            ["percent", "seen", "scene"]
        ].assign(end=f"{end} end")
        for end in ("blossom", "stem")
    ).dropna(subset="percent")
    in_sight = ends["seen"].astype(bool)
    groups = {
        "all": ends,
        "in sight": ends[in_sight],
        "hidden": ends[~in_sight],
        "blossom end": ends[ends["end"] == "blossom end"],
        "stem end": ends[ends["end"] == "stem end"],
    }
    cells: list[tuple[Cell, ...]] = []
    for name, part in groups.items():
        if len(part):
            median, p90 = (estimate(part["percent"], part["scene"], q) for q in (0.5, 0.9))
            cells.append(
                (name, median.count, median.groups, *_spanned(median, 2), *_spanned(p90, 2))
            )
    value = "–" if math.isnan(swapped.value) else f"{100 * swapped.value:.2f} %"
    span = benchmark_report.span_text(swapped, 2, 100) or "–"
    comment = (
        "Distance between the true and the found end, in percent of the line through the fruit's "
        "five true keypoints in the picture; found fruit with keypoints. Ends swapped on "
        f"{value} of {swapped.count} fruit (95 % by scene: {span}); "
        "swapped ends are not corrected first."
    )
    heads = ["ends", "n", "scenes", "median (% of length)", "95 %"]
    heads += ["90th percentile (% of length)", "95 % by scene"]
    return ReportTable.of(title, heads, cells, comment)


def pose_table(readings: pd.DataFrame) -> ReportTable:
    """Return how far the stem ends are off in space, and how often the ends are swapped.

    Parameters
    ----------
    readings : DataFrame
        With the columns of `run.pose_errors`.
    """
    posed = readings.drop_duplicates(["case", "masks"]).dropna(subset="swapped")
    in_range = posed["distance_m"].between(*_NEAR_M)
    perceived = posed["masks"] == Masks.PERCEIVED
    sure = posed["stem_confidence"] >= LEAST_END_CONFIDENCE
    groups = {
        "true masks, keypoints": posed[in_range & ~perceived],
        "perceived": posed[in_range & perceived],
        "perceived, both ends in sight": posed[in_range & perceived & posed["whole"].astype(bool)],
        "perceived, ends 90 % sure": posed[in_range & perceived & sure],
        "perceived, farther": posed[~in_range & perceived],
    }
    if "hangs" in posed:
        hanging = posed[perceived & posed["hangs"].eq(True)]
        groups["perceived, hanging, any distance"] = hanging
        groups["the same, gravity known"] = hanging.assign(swapped=hanging["swapped_by_gravity"])
    cells: list[tuple[Cell, ...]] = []
    for name, part in groups.items():
        right = part.dropna(subset="stem_mm")
        if len(right):
            median_p90, turned = (
                [float(value) for value in right[column].quantile([0.5, 0.9])]
                for column in ("stem_mm", "stem_deg")
            )
            inside = right["cut_in_90"].dropna().astype(float)
            swapped = 100 * float(part["swapped"].astype(float).mean())
            cells.append(
                (name, len(part), swapped, *median_p90, *turned, 100 * float(inside.mean()))
            )
    heads = ["fruit", "n", "swapped (%):.1", "stem end median (mm):.1", "90th percentile:.1"]
    heads += ["direction median (deg):.1", "90th:.1", "cut in 90 % (%):.0"]
    comment = (
        f"At {_NEAR_M[0]:g} to {_NEAR_M[1]:g} m unless stated otherwise. Distances of fruit whose "
        "ends are not swapped, hidden ends included. The last column: how often the true place "
        "to cut lies in its ellipsoid of 90 %."
    )
    return ReportTable.of("Poses", heads, cells, comment)


def photo_tables(photos: Evaluation) -> list[ReportTable]:
    """Return recall, precision, errors of ends and false positives on real photos."""
    confidence = photos.networks.confidence
    tests, settings = (
        sorted({photo.extras[name] for photo in photos.data.pictures})
        for name in ("test", "setting")
    )
    named = [("all", photos.score())]
    named += [(f"test: {name}", photos.score(test=name)) for name in tests]
    if photos.small:
        named += [("half size: all", photos.score(small=True))]
        named += [(f"half size: {name}", photos.score(small=True, test=name)) for name in tests]
    named += [(f"where: {name}", photos.score(setting=name)) for name in settings]
    comment = (
        f"At confidence {confidence:g}, on scenes that were never trained on. Whole "
        "cucumbers are to be found; a courgette may be, once; anything else is false. Detections "
        "of which half lies in an ignored region are not counted. At half size each photo lies "
        "shrunk in the middle of a grey picture. "
        + f"{len(photos.frames)} photos of {len({x.scene for x in photos.frames})} scenes"
        + (f"; {photos.missing} of the audit's photos are missing." if photos.missing else ".")
    )
    ends = outcomes.end_rows(photos.frames, confidence)
    tables = [_share_table("Real photos", "photos", named, comment)]
    tables += [end_table(ends, "Ends on real photos")] if len(ends) else []
    return [*tables, _false_table(photos)]


def _false_table(photos: Evaluation) -> ReportTable:
    """Return the false positives on real photos, most confident first."""
    rows = outcomes.detection_rows(photos.frames, photos.networks.confidence)
    false = rows[rows["outcome"] == "false"].sort_values("score", ascending=False, kind="stable")
    cells = [
        (r.picture, r.scene, r.score, f"{r.x1:.0f}, {r.y1:.0f} to {r.x2:.0f}, {r.y2:.0f}")
        for r in false.head(_MOST_FALSE_SHOWN).itertuples()
    ]
    title = f"False detections on real photos ({len(false)})"
    heads = ["photo", "scene", "confidence:.3", "box (px)"]
    return ReportTable.of(title, heads, cells, "The photos themselves are not shown.")


def _spanned(span: Estimate, decimals: int = 3) -> tuple[float, str | None]:
    return span.value, benchmark_report.span_text(span, decimals)


def _share_table(
    title: str, first: str, named: Sequence[tuple[str, outcomes.Score]], comment: str = ""
) -> ReportTable:
    """Return a table of recall and precision by name."""
    heads = [first, "fruit", "scenes", "recall:.3", "95 % by scene", "detections"]
    heads += ["scenes with detections", "precision:.3", "precision, 95 % by scene"]
    rows = [
        (name, *_share_cells(score.recall), *_share_cells(score.precision)) for name, score in named
    ]
    return ReportTable.of(title, heads, rows, comment)


def _share_cells(share: Estimate | None) -> tuple[Cell, ...]:
    return (None,) * 4 if share is None else (share.count, share.groups, *_spanned(share))


def write_detection_report(result: Evaluation, tables: Sequence[ReportTable], out: Path) -> Path:
    """Write `results.json` with all tables, and CSV files of fruit, detections, ends and lengths.

    Raises
    ------
    CucumberVisionError
        If a file cannot be written.
    """
    frames, networks = result.frames, result.networks
    provenance = {
        "software": f"cucumbervision {__version__}",
        "licence": LICENCE,
        "data set": result.data.folder.name,
        "split": ", ".join(sorted({picture.split for picture in result.data.pictures})),
        "pictures": len(frames),
        "scenes": len({frame.scene for frame in frames}),
        "fruit to be found": sum(fruit.required for frame in frames for fruit in frame.true),
        "confidence": networks.confidence,
        "input sizes (px)": list(networks.input_sizes) or "each network's own",
        "networks": networks.models,
        "median seconds a picture": {
            name: round(float(np.median(values)), 3) for name, values in result.seconds.items()
        },
        "duration (s)": round(result.duration_s),
        "versions": installed_versions(),
    }
    rows = _rows(result) | {
        "ends": outcomes.end_rows(frames, networks.confidence),
        "lengths": result.readings.reindex(columns=_LENGTH_COLUMNS),
    }
    return _written(out / "results.json", provenance, tables, rows)


def write_photo_report(result: Evaluation, tables: Sequence[ReportTable], out: Path) -> Path:
    """Write `photos.json`, `photo_fruit.csv` and `photo_detections.csv`.

    Raises
    ------
    CucumberVisionError
        If a file cannot be written.
    """
    provenance = {"confidence": result.networks.confidence}
    rows = {f"photo_{name}": frame for name, frame in _rows(result).items()}
    return _written(out / "photos.json", provenance, tables, rows)


def _rows(result: Evaluation) -> dict[str, pd.DataFrame]:
    evaluated = result.frames, result.networks.confidence
    return {
        "fruit": outcomes.fruit_rows(*evaluated),
        "detections": outcomes.detection_rows(*evaluated),
    }


def _written(
    path: Path,
    provenance: Mapping[str, object],
    tables: Sequence[ReportTable],
    rows: Mapping[str, pd.DataFrame],
) -> Path:
    benchmark_report.write_tables(path, provenance, tables)
    with wrap_os_errors("cannot be written", path.parent):
        for name, frame in rows.items():
            cells = frame.round(6).astype(object).where(frame.notna(), None)
            write_csv(path.with_name(f"{name}.csv"), list(frame.columns), cells.to_dict("records"))
    return path
