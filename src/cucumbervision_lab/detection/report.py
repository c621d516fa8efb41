"""Everything an evaluation leaves behind: figures as JSON, rows as CSV, one page of HTML."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, installed_versions
from cucumbervision.accuracy.statistics import Estimate
from cucumbervision.capture.files import json_value
from cucumbervision.errors import CucumberVisionError
from cucumbervision.pipeline.fields import defused
from cucumbervision.pipeline.tables import write_json
from cucumbervision_lab.detection import plots
from cucumbervision_lab.detection.figures import (
    end_table,
    false_table,
    group_table,
    length_table,
    overall_table,
    overlap_table,
    part_table,
    photo_end_table,
    photo_table,
    precision_table,
    score_ends,
)
from cucumbervision_lab.detection.outcomes import HIDDEN_SHARE, EndRow, FoundRow, FruitRow
from cucumbervision_lab.detection.picture_result import OverlapRow
from cucumbervision_lab.detection.plots import KINDS, draw_sheet, worst_cases
from cucumbervision_lab.report.page import HTML_NAME, Plot, Section, render_page
from cucumbervision_lab.report.records import readings_frame

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from cucumbervision.accuracy.table import Table
    from cucumbervision_lab.detection.figures import EndScore, Summary
    from cucumbervision_lab.detection.outcomes import GroupScore
    from cucumbervision_lab.detection.photos import PhotoResult
    from cucumbervision_lab.detection.run import DetectionResult

_JSON_NAME = "results.json"
_CARD_NAME = "card.json"
# What fits a model's card: what was judged on what, and the figures over all fruit.
_CARD_KEYS = (
    "software",
    "data set",
    "split",
    "pictures",
    "confidence",
    "networks",
    "average_precision",
    "overall",
    "ends",
    "ends_swapped",
    "masks",
    "parts",
)
_LENGTH_COLUMNS = (
    *("fruit", "scene", "masks", "method", "length_m", "centreline_m", "thread_m", "chord_m"),
    *("missed", "hidden_share", "cut_off", "distance_m", "selected"),
)
_GLOSSARY = (
    ("recall", "Share of the fruit that should be found which were."),
    ("precision", "Share of the detections that are fruit."),
    (
        "mAP50, mAP50-95",
        "Average precision: the area under precision against recall over all confidences, where a "
        "hit must overlap by 0.50, and the mean over 0.50, 0.55 … 0.95 (COCO).",
    ),
    ("IoU", "Intersection over union: 1 where two boxes or masks are the same, 0 where apart."),
    (
        "object keypoint similarity",
        "COCO's measure of how well keypoints agree: 1 where all do, falling with their distance "
        "over the fruit's size.",
    ),
    (
        "95 % by scene",
        "Interval of the figure if whole scenes are drawn again at random (bootstrap); pictures of "
        "one scene resemble each other. Where all or none of the fruit are hits, the exact "
        "interval of as many trials as there are scenes.",
    ),
    ("hidden share", "How much of the fruit's outline something else hides."),
)


def main_tables(summary: Summary, confidence: float, photos: PhotoResult | None) -> list[Table]:
    """Return the tables that say most, for the screen and for the page's top.

    Parameters
    ----------
    summary : Summary
        The figures.
    confidence : float
        At which recall and precision were judged.
    photos : PhotoResult, optional
        On real photos.
    """
    tables = [precision_table(summary), overall_table(summary, confidence)]
    hidden = group_table(summary, HIDDEN_SHARE)
    tables += [hidden] if hidden.rows else []
    tables += [part_table(summary.parts)] if summary.parts else []
    tables += [end_table(summary.ends, summary.swapped)] if summary.ends else []
    tables += [overlap_table(summary)] if summary.overlaps else []
    tables += [length_table(summary, "centreline", "whole")] if summary.lengths else []
    tables += photo_tables(photos) if photos else []
    return tables


def _card_numbers(numbers: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of `results.json` that a model's card holds.

    Examples
    --------
    >>> _card_numbers({"pictures": 3, "groups": [1, 2], "photos": {"photos": 2, "false": [1]}})
    {'pictures': 3, 'photos': {'photos': 2}}
    """
    card = {key: numbers[key] for key in _CARD_KEYS if numbers.get(key)}
    photos = numbers.get("photos")
    if photos:
        card["photos"] = {key: value for key, value in photos.items() if key != "false"}
    return card


def write_detection_report(result: DetectionResult, summary: Summary, out: Path) -> Path:
    """Write `results.json`, `card.json`, the CSV files and `report.html`.

    Of real photos only figures, file names and boxes are written.

    Parameters
    ----------
    result : DetectionResult
        What was seen.
    summary : Summary
        Its figures.
    out : Path
        The folder, made if it is missing.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    CucumberVisionError
        If the folder cannot be written.
    MissingExtraError
        If matplotlib or Jinja2 is not installed; JSON and CSV are written before.
    """
    with _made(out):
        numbers = _numbers(result, summary)
        write_json(out / _JSON_NAME, numbers)
        write_json(out / _CARD_NAME, _card_numbers(numbers))
        _write_rows(out / "fruit.csv", summary.fruit, FruitRow)
        _write_rows(out / "detections.csv", summary.found, FoundRow)
        _write_rows(out / "ends.csv", summary.end_rows, EndRow)
        _write_rows(out / "masks.csv", result.overlaps, OverlapRow)
        readings = readings_frame(result.records) if result.records else pd.DataFrame()
        _write_csv(out / "lengths.csv", readings.reindex(columns=_LENGTH_COLUMNS))
        if result.photos:
            _write_photo_rows(result.photos, out)
        (out / HTML_NAME).write_text(_page(result, summary), encoding="utf-8")
    return out / HTML_NAME


def photo_tables(photos: PhotoResult) -> list[Table]:
    """Return the tables of what was found on real photos: shares, and ends where they were read."""
    return [photo_table(photos)] + ([photo_end_table(photos)] if photos.ends else [])


def write_photo_report(photos: PhotoResult, out: Path) -> Path:
    """Write `photos.json`, `photo_fruit.csv` and `photo_detections.csv`: figures, names and boxes.

    Parameters
    ----------
    photos : PhotoResult
        What was found on real photos.
    out : Path
        The folder, made if it is missing.

    Returns
    -------
    Path
        `photos.json`.

    Raises
    ------
    CucumberVisionError
        If a file cannot be written.
    """
    file = out / "photos.json"
    with _made(out):
        write_json(file, {"confidence": photos.confidence} | _photo_numbers(photos))
        _write_photo_rows(photos, out)
    return file


@contextmanager
def _made(out: Path) -> Iterator[None]:
    """Make a folder to write into; say in one line what cannot be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise CucumberVisionError(
            f"cannot be written ({error.strerror})", source=out, remedy="choose another --out"
        ) from error


def _write_photo_rows(photos: PhotoResult, out: Path) -> None:
    _write_rows(out / "photo_fruit.csv", photos.fruit, FruitRow)
    _write_rows(out / "photo_detections.csv", photos.found, FoundRow)


def _page(result: DetectionResult, summary: Summary) -> str:
    confidence, photos = result.plan.confidence, result.photos
    first, *rest = main_tables(summary, confidence, None)
    sections = [Section("Main figures", (), tuple(rest)), _group_section(summary)]
    if summary.end_rows:
        caption = "How many ends are set off by at most so much; lines at 2 % and 6 %."
        plot = Plot(caption, plots.end_error_plot(summary.end_rows))
        sections.append(Section("Keypoints", (), (plot,)))
    sections += _overlap_sections(result)
    sections += _length_sections(summary)
    if photos is not None:
        sections.append(Section("Real photos", (), (*photo_tables(photos), false_table(photos))))
    sections += _worst_sections(result, summary)
    notes = [("", _intro(result))]
    return render_page(
        "Detection evaluation: what the networks find",
        notes,
        first,
        sections,
        _provenance(result),
        glossary=_GLOSSARY,
        numbers=_JSON_NAME,
    )


def _intro(result: DetectionResult) -> str:
    plan = result.plan
    fruit = sum(one.required for frame in result.frames for one in frame.true)
    scenes = len({frame.scene for frame in result.frames})
    return (
        f"{len(result.frames)} pictures of {scenes} scenes with {fruit} fruit to be found "
        f"(split '{plan.split}' of {plan.data.name}). SAM and lengths: at most {plan.sam_limit} "
        "of these pictures, evenly spread."
    )


def _group_section(summary: Summary) -> Section:
    factors = list(dict.fromkeys(one.factor for one in summary.groups))
    caption = "Recall (blue) and precision (orange) of what is reported; bars: 95 % by scene."
    entries: list[Table | Plot] = [Plot(caption, plots.recall_plot(summary.groups))]
    entries += [group_table(summary, factor) for factor in factors]
    intro = (
        "Recall goes by the fruit's own properties, precision by the detection's: its box's size, "
        "whether it reaches the border, and the depth in its middle. How much of a false "
        "detection is hidden is not known.",
    )
    return Section("By distance, size, occlusion and edge", intro, tuple(entries))


def _overlap_sections(result: DetectionResult) -> list[Section]:
    entries = []
    for name, simulated in (("Drawn", True), ("Real", False)):
        rows = [r for r in result.overlaps if r.simulated is simulated]
        if rows:
            caption = f"{name} pictures: how many masks overlap by at least so much."
            entries.append(Plot(caption, plots.overlap_plot(rows)))
    return [Section("Masks, one by one", (), tuple(entries))] if entries else []


def _length_sections(summary: Summary) -> list[Section]:
    asked = list(dict.fromkeys((one.truth, one.group) for one in summary.lengths))
    tables = [length_table(summary, truth, group) for truth, group in asked]
    intro = (
        "Every fruit measured twice: on its true mask and keypoints, and on what the networks "
        "made of it (SAM, where it took part, prompted by box and centre).",
    )
    return [Section("Lengths", intro, tuple(tables))] if tables else []


def _worst_sections(result: DetectionResult, summary: Summary) -> list[Section]:
    cases = worst_cases(result, summary)
    sheets = []
    for kind, words in KINDS.items():
        some = [case for case in cases if case.kind == kind]
        if some:
            caption = f"{words} Green: what is there; orange: what was found."
            sheets.append(Plot(caption, draw_sheet(some, result)))
    return [Section("The worst cases", (), tuple(sheets))] if sheets else []


def _provenance(result: DetectionResult) -> dict[str, Any]:
    seconds = {
        f"{name} (median s a picture)": f"{np.median(values):.3f}"
        for name, values in result.seconds.items()
    }
    return {
        "software": f"cucumbervision {__version__}",
        "data set": result.plan.data.name,
        "split": result.plan.split,
        "confidence": result.plan.confidence,
        "input sizes (px)": list(result.plan.input_sizes) or "each network's own",
        "networks": result.models,
        **seconds,
        "duration (s)": f"{result.duration_s:.0f}",
        "versions": installed_versions(),
    }


def _numbers(result: DetectionResult, summary: Summary) -> dict[str, Any]:
    return {
        **_provenance(result),
        "licence": LICENCE,
        "pictures": len(result.frames),
        "average_precision": [
            {"stage": str(one.stage), "of": one.judged.name.lower()}
            | _estimates(one, leave=("stage", "judged"))
            for one in summary.precisions
        ],
        "overall": {str(stage): _scores(one) for stage, one in summary.overall},
        "groups": [_estimates(one, leave=("middle",)) for one in summary.groups],
        **_end_numbers(summary.ends, summary.swapped),
        "masks": [_estimates(one) for one in summary.overlaps],
        "parts": [_estimates(one) for one in summary.parts],
        "lengths": [
            {**_estimates(one, leave=("metrics",)), **json_value(vars(one.metrics))}
            for one in summary.lengths
        ],
        "photos": None if result.photos is None else _photo_numbers(result.photos),
    }


def _end_numbers(ends: Sequence[EndScore], swapped: Estimate) -> dict[str, Any]:
    scores = {one.ends: _estimates(one, leave=("ends",)) for one in ends}
    return {"ends": scores, "ends_swapped": _estimate(swapped)}


def _estimates(one: Any, leave: Sequence[str] = ()) -> dict[str, Any]:
    """Return a score's fields as JSON holds them, but for those to leave out."""
    return {
        name: _estimate(value) if isinstance(value, Estimate) else json_value(value)
        for name, value in vars(one).items()
        if name not in leave
    }


def _estimate(one: Estimate) -> dict[str, Any]:
    interval = {"value": one.value, "low": one.low, "high": one.high}
    return {**json_value(interval), "n": one.count, "scenes": one.groups}


def _photo_numbers(photos: PhotoResult) -> dict[str, Any]:
    return {
        "photos": photos.photos,
        "scenes": photos.scenes,
        "missing": photos.missing,
        "scores": {name: _scores(one) for name, one in photos.scores},
        "tests": {name: _scores(one) for name, one in photos.tests},
        **_end_numbers(*score_ends(photos.ends)),
        "half_size": {name: _scores(one) for name, one in photos.small},
        "false": [json_value(asdict(r)) for r in photos.found if r.outcome == "false"],
    }


def _scores(one: GroupScore) -> dict[str, Any]:
    return _estimates(one, leave=("factor", "group", "middle"))


def _write_rows(path: Path, rows: Sequence[Any], kind: type) -> None:
    """Write dataclasses as CSV, one a line."""
    names = [one.name for one in fields(kind)]
    _write_csv(path, pd.DataFrame([asdict(row) for row in rows], columns=names))


def _write_csv(path: Path, frame: pd.DataFrame) -> None:
    """Write a frame as CSV; what is not known stays empty, and no text becomes a formula."""
    texts = frame.map(lambda cell: defused(cell) if isinstance(cell, str) else cell)
    texts.round(6).to_csv(path, index=False, lineterminator="\r\n")
