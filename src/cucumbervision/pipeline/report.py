"""What a run leaves behind besides its rows: JSON with provenance, and the workbook."""

from __future__ import annotations

import platform
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, installed_versions, source_offer
from cucumbervision.pipeline.exports import write_json, write_workbook
from cucumbervision.pipeline.summary import summary_lines

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime

    from cucumbervision.calibration.calibration_file import SiteCalibration
    from cucumbervision.capture.frames import Capture
    from cucumbervision.measurement.result import Fruit, Measurement
    from cucumbervision.pipeline.finders import Finder
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.pipeline.results import RunResult
    from cucumbervision.pipeline.rows import Cell

__all__ = ["capture_json", "write_reports"]


def capture_json(
    capture: Capture, fruit: Sequence[Fruit], rows: Sequence[dict[str, Cell]]
) -> dict[str, Any]:
    """Give one capture for `measurements.json`: camera, provenance, fruit, every method.

    Parameters
    ----------
    capture : Capture
        The frame.
    fruit : sequence of Fruit
        Its fruit, measured.
    rows : sequence of dict
        Their rows, in the same order.
    """
    camera = capture.intrinsics
    return {
        "name": capture.name,
        "frame": capture.frame,
        "source": capture.source,
        "simulated": capture.simulated,
        "intrinsics": {
            "stream": str(camera.stream),
            "width": camera.width,
            "height": camera.height,
            "fx_px": camera.fx_px,
            "fy_px": camera.fy_px,
            "cx_px": camera.cx_px,
            "cy_px": camera.cy_px,
            "distortion": str(camera.distortion),
            "coefficients": list(camera.coefficients),
        },
        "provenance": dict(capture.provenance),
        "fill": round(capture.fill, 4),
        "fruit": [
            {**row, "methods": {str(m): _method_json(x) for m, x in one.measurements.items()}}
            for row, one in zip(rows, fruit, strict=True)
        ],
    }


def _method_json(measurement: Measurement) -> dict[str, Any]:
    path = measurement.path_m
    return {
        "length_m": measurement.length_m,
        "kind": measurement.kind and str(measurement.kind),
        "reason": str(measurement.reason),
        "fallback": list(measurement.fallback),
        "tips_m": None if path is None else np.round(path[[0, -1]], 5).tolist(),
    }


def write_reports(
    result: RunResult,
    captures: list[dict[str, Any]],
    finder: Finder,
    options: MeasureOptions,
    started: datetime,
    site: SiteCalibration | None = None,
) -> None:
    """Write `measurements.json` and `measurements.xlsx` of a whole run.

    Parameters
    ----------
    result : RunResult
        The run.
    captures : list of dict
        From `capture_json`.
    finder : Finder
        Whose networks took part.
    options : MeasureOptions
        The run's choices.
    started : datetime
        When it began, UTC.
    site : SiteCalibration, optional
        The calibration that was applied.
    """
    provenance = {
        "software": f"cucumbervision {__version__}",
        "licence": LICENCE,
        "source": source_offer(),
        "started": started.isoformat(timespec="seconds"),
        "config": options.as_json(),
        "config_sha256": options.sha256,
        "models": finder.models,
        "calibration": site and {"tag": site.tag, **site.model_dump(mode="json")},
        "versions": {"python": platform.python_version(), **installed_versions()},
    }
    failures = [vars(failure) for failure in result.failures]
    report = {**provenance, "captures": captures, "failures": failures}
    write_json(result.out / "measurements.json", report)
    write_workbook(result.out / "measurements.xlsx", result.rows, summary_lines(result, provenance))
