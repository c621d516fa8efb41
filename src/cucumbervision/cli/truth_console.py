"""What an evaluation and a calibration look like on screen."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from cucumbervision.accuracy.measured import read_measured
from cucumbervision.accuracy.own_report import write_own_report
from cucumbervision.accuracy.own_truth import evaluate_lengths
from cucumbervision.accuracy.truth import read_truth
from cucumbervision.calibration.calibration_file import write_site_calibration
from cucumbervision.calibration.corrections import Form
from cucumbervision.calibration.site_calibration import calibrate_depth, calibrate_lengths
from cucumbervision.errors import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from cucumbervision.accuracy.own_truth import MethodScore
    from cucumbervision.calibration.calibration_file import CorrectionEntry, SiteCalibration

__all__ = ["calibrate_and_show", "evaluate_and_show"]

WIDTH = 120


def evaluate_and_show(measurements: Path, truth: Path, out: Path) -> None:
    """Evaluate, print the scores and write the report."""
    measured, table = read_measured(measurements), read_truth(truth)
    found = evaluate_lengths(measured, table)
    console = _console()
    console.print(_scores_table(found.scores))
    for note in found.notes:
        console.print(note, soft_wrap=True, markup=False)
    write_own_report(found, out, measured, table)
    console.print(f"The report is in {out}/", soft_wrap=True, markup=False)


def calibrate_and_show(
    measurements: Path,
    truth: Path | None,
    out: Path,
    *,
    name: str,
    reference_m: float | None,
    method: str | None,
    level: float,
) -> None:
    """Calibrate, write the file and print what is in it.

    Raises
    ------
    CalibrationError
        If neither hand-measured lengths nor a reference length were given.
    """
    measured = read_measured(measurements)
    if reference_m is not None:
        site = calibrate_depth(measured, reference_m, name, truth, method)
    elif truth is None:
        raise CalibrationError(
            "there is nothing to calibrate with",
            source="calibrate",
            remedy="give a CSV of hand-measured lengths, or --reference-length in metres",
        )
    else:
        site = calibrate_lengths(measured, read_truth(truth), name, level)
    write_site_calibration(out, site)
    _show_site(_console(), site)
    _console().print(f"{site.tag} is in {out}", soft_wrap=True, markup=False)


def _console() -> Console:
    # A file or a pipe has no width of its own; 80 columns would cut the table.
    return Console(highlight=False, width=None if Console().is_terminal else WIDTH)


def _scores_table(scores: Sequence[MethodScore]) -> Table:
    table = Table(title="Errors against hand-measured lengths", title_justify="left")
    for head in ("truth", "method"):
        table.add_column(head)
    for head in ("captures", "fruit", "measured", "MAE cm", "MAPE %", "95 % by fruit"):
        table.add_column(head, justify="right")
    for head in ("median %", "worst %", "bias %"):
        table.add_column(head, justify="right")
    for one in scores:
        m = one.metrics
        table.add_row(
            str(one.kind),
            one.method,
            str(m.count),
            str(one.fruit),
            f"{100 * m.measured:.0f} %",
            f"{m.mae_cm:.2f}",
            f"{m.mape_percent:.2f}",
            _range(one),
            f"{m.median_percent:.2f}",
            f"{m.worst_percent:.2f}",
            f"{m.bias_percent:+.2f}" if m.measured else "",
        )
    return table


def _range(one: MethodScore) -> str:
    known = math.isfinite(one.low_percent)
    return f"{one.low_percent:.2f}–{one.high_percent:.2f}" if known else ""


def _show_site(console: Console, site: SiteCalibration) -> None:
    if site.depth_scale is not None:
        scale = site.depth_scale
        console.print(
            f"Depth scale {scale.value:.5f} ± {scale.standard_error:.5f} (standard error) from "
            f"{scale.captures} captures of a bar of {scale.reference_length_m:g} m by "
            f"{scale.method}; depth is divided by it.",
            soft_wrap=True,
        )
    if site.corrections:
        console.print(_corrections_table(site.corrections))
        for entry in site.corrections:
            console.print(
                f"{entry.method} ({entry.truth_kind}): {entry.reason}; interval: "
                f"{entry.interval.reason}",
                soft_wrap=True,
                markup=False,
            )


def _corrections_table(entries: Sequence[CorrectionEntry]) -> Table:
    table = Table(title="Corrections, tried on fruit left out of the fit", title_justify="left")
    for head in ("truth", "method", "correction"):
        table.add_column(head)
    for head in ("fruit", "captures", "error before %", "after %", "rest sd %", "interval ± %"):
        table.add_column(head, justify="right")
    for entry in entries:
        half = entry.interval.half_width
        table.add_row(
            str(entry.truth_kind),
            entry.method,
            _formula(entry),
            str(entry.fruit),
            str(entry.captures),
            f"{entry.error_before_percent:.2f}",
            f"{entry.error_after_percent:.2f}",
            f"{entry.residual_sd_percent:.2f}",
            "none" if half is None else f"{100 * half:.2f}",
        )
    return table


def _formula(entry: CorrectionEntry) -> str:
    if entry.form is Form.NONE:
        return "none"
    offset = f" {100 * entry.offset_m:+.2f} cm" if entry.form is Form.SCALE_OFFSET else ""
    return f"x {entry.scale:.4f}{offset}"
