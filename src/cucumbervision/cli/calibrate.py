"""`cucumbervision calibrate`: a site's correction from hand-measured fruit or a known bar."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.accuracy.table import Table
    from cucumbervision.calibration.calibration_file import CorrectionEntry, SiteCalibration


def calibrate(
    measurements: Annotated[
        Path, typer.Argument(help="Folder of a `measure` run, or its measurements.json.")
    ],
    truth: Annotated[
        Path | None,
        typer.Argument(
            help="CSV of hand-measured lengths, as for `evaluate lengths`; with "
            "--reference-length, optionally, which rows are the bar (capture, fruit)."
        ),
    ] = None,
    *,
    out: Annotated[Path, typer.Option("--out", "-o", help="Calibration file to write (JSON).")],
    name: Annotated[
        str | None, typer.Option(help="What rows call it; the file's name without it.")
    ] = None,
    reference_length: Annotated[
        float | None,
        typer.Option(help="Length in metres of a bar that the captures show: the depth scale."),
    ] = None,
    method: Annotated[
        str | None, typer.Option(help="Whose length of the bar counts: 'M6 chord', M3 …")
    ] = None,
    level: Annotated[float, typer.Option(min=0.5, max=0.99, help="Level of the intervals.")] = 0.90,
) -> None:
    """Fit corrections to hand-measured fruit, or the depth scale to a bar of known length."""
    from cucumbervision.accuracy.measured import read_measured
    from cucumbervision.accuracy.truth import read_truth
    from cucumbervision.calibration.calibration_file import write_site_calibration
    from cucumbervision.calibration.site_calibration import calibrate_depth, calibrate_lengths
    from cucumbervision.errors import CalibrationError

    measured = read_measured(measurements)
    if reference_length is not None:
        site = calibrate_depth(measured, reference_length, name or out.stem, truth, method)
    elif truth is None:
        raise CalibrationError(
            "there is nothing to calibrate with",
            source="calibrate",
            remedy="give a CSV of hand-measured lengths, or --reference-length in metres",
        )
    else:
        site = calibrate_lengths(measured, read_truth(truth), name or out.stem, level)
    write_site_calibration(out, site)
    _show(site, out)


def _show(site: SiteCalibration, out: Path) -> None:
    from cucumbervision.cli.console import print_table, screen

    console = screen(150)
    if site.depth_scale is not None:
        scale = site.depth_scale
        console.print(
            f"Depth scale {scale.value:.5f} ± {scale.standard_error:.5f} (standard error) from "
            f"{scale.captures} captures of a bar of {scale.reference_length_m:g} m by "
            f"{scale.method}; depth is divided by it.",
            soft_wrap=True,
        )
    if site.corrections:
        print_table(console, _corrections_table(site.corrections))
        for entry in site.corrections:
            console.print(
                f"{entry.method} ({entry.truth_kind}): {entry.reason}; interval: "
                f"{entry.interval.reason}",
                soft_wrap=True,
                markup=False,
            )
    console.print(f"{site.tag} is in {out}", soft_wrap=True, markup=False)


_CORRECTIONS = {
    "truth_kind": "truth",
    "method": "method",
    "formula": "correction",
    "fruit": "fruit",
    "captures": "captures",
    "error_before_percent": "error before %",
    "error_after_percent": "after %",
    "residual_sd_percent": "rest sd %",
    "half_width_percent": "interval ± %",
}


def _corrections_table(entries: Sequence[CorrectionEntry]) -> Table:
    from cucumbervision.accuracy.table import Table

    rows = []
    for entry in entries:
        half = entry.interval.half_width
        percent = None if half is None else 100 * half
        rows.append(vars(entry) | {"formula": _formula(entry), "half_width_percent": percent})
    return Table.of_records("Corrections, tried on fruit left out of the fit", _CORRECTIONS, rows)


def _formula(entry: CorrectionEntry) -> str:
    from cucumbervision.calibration.corrections import Form

    if entry.form is Form.NONE:
        return "none"
    offset = f" {100 * entry.offset_m:+.2f} cm" if entry.form is Form.SCALE_OFFSET else ""
    return f"x {entry.scale:.4f}{offset}"
