"""The report of an evaluation on one's own fruit."""

from __future__ import annotations

import json
import platform
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, installed_versions, source_offer
from cucumbervision.accuracy.page import Table, write_report
from cucumbervision.accuracy.records import append_record, readings_frame
from cucumbervision.capture.files import json_value
from cucumbervision.errors import CucumberVisionError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from cucumbervision.accuracy.measured import Measured
    from cucumbervision.accuracy.own_truth import MethodScore, OwnTruth
    from cucumbervision.accuracy.truth import Truth

__all__ = ["RECORDS", "SCORES", "scores_table", "write_own_report"]

RECORDS = "records.jsonl"
SCORES = "scores.json"
TITLE = "Your own fruit"


def write_own_report(found: OwnTruth, out: Path, measured: Measured, truth: Truth) -> None:
    """Write the report over one's own fruit, its records and its scores.

    `out` gets `scores.json` (what the command prints), `records.jsonl`, and the report.

    Raises
    ------
    CucumberVisionError
        If the folder cannot be written.
    MissingExtraError
        If what draws the page is not installed; scores and records are written before it.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / RECORDS).unlink(missing_ok=True)
        for record in found.records:
            append_record(out / RECORDS, record)
        provenance = _provenance(measured, truth)
        floor = found.floor and asdict(found.floor)
        scores = [json_value(asdict(one)) for one in found.scores]
        head = {**_software(), **provenance, "notes": found.notes, "floor": floor, "scores": scores}
        text = json.dumps(head, indent=1, ensure_ascii=False)
        (out / SCORES).write_text(text + "\n", encoding="utf-8")
        _write_page(found, out, provenance)
    except OSError as error:
        raise CucumberVisionError(
            f"cannot be written ({error.strerror})", source=out, remedy="choose another --out"
        ) from error


_SCORES = {
    "kind": "truth",
    "method": "method",
    "count": "captures",
    "fruit": "fruit",
    "measured_percent": "measured %:.0",
    "mae_cm": "MAE cm",
    "mape_percent": "MAPE %",
    "low_percent": "95 % by fruit, from",
    "high_percent": "to",
    "median_percent": "median %",
    "worst_percent": "worst %",
    "bias_percent": "bias %:+.2",
}


def scores_table(scores: Sequence[MethodScore]) -> Table:
    """Return each method's errors against each kind of hand-measured length."""
    rows = [
        vars(one.metrics) | vars(one) | {"measured_percent": 100 * one.metrics.measured}
        for one in scores
    ]
    return Table.of_records("Errors against hand-measured lengths", _SCORES, rows)


def _write_page(found: OwnTruth, out: Path, provenance: dict[str, Any]) -> None:
    if not found.records:
        raise CucumberVisionError(
            "there is nothing to report", source=out, remedy="measure at least one fruit first"
        )
    readings = readings_frame(found.records)
    from cucumbervision.accuracy.length_report import GLOSSARY, reading_section

    count, fruit = readings["case"].nunique(), readings["fruit"].nunique()
    intro = (
        "Fruit measured by hand, held against what this program read from their captures.",
        f"{count} measurements of {fruit} fruit.",
    )
    write_report(
        out,
        "Lengths against one's own ground truth",
        scores_table(found.scores),
        [reading_section(TITLE, intro, readings)],
        notes=[("", "\n\n".join(found.notes))],
        provenance=provenance,
        glossary=GLOSSARY,
        numbers={"records": count},
    )


def _provenance(measured: Measured, truth: Truth) -> dict[str, Any]:
    report = measured.report
    return {
        "measurements": str(measured.path),
        "measured_with": report.get("software"),
        "config_sha256": report.get("config_sha256"),
        "models": report.get("models", []),
        "calibration": (report.get("calibration") or {}).get("tag"),
        "truth": str(truth.path),
        "truth_sha256": truth.sha256,
    }


def _software() -> dict[str, Any]:
    return {
        "software": f"cucumbervision {__version__}",
        "licence": LICENCE,
        "source": source_offer(),
        "versions": {"python": platform.python_version(), **installed_versions()},
    }
