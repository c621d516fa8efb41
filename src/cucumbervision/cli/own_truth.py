"""`cucumbervision calibrate`: corrections by hand-measured fruit, or by a printed grid."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from cucumbervision.accuracy.calibration_file import CorrectionEntry, SiteCalibration


def calibrate(
    measurements: Annotated[
        Path,
        typer.Argument(
            help="Folder of a `measure` run, or its measurements.json; with --grid, captures."
        ),
    ],
    truth: Annotated[
        Path | None, typer.Argument(help="CSV of hand-measured lengths, as for `evaluate lengths`.")
    ] = None,
    *,
    out: Annotated[Path, typer.Option("--out", "-o", help="Calibration file to write (JSON).")],
    name: Annotated[
        str | None, typer.Option(help="Name in the rows; default: the name of the file.")
    ] = None,
    grid: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            metavar="MM",
            help="Millimetres between the lines of a flat square grid that the captures show: "
            "depth scale and lens.",
        ),
    ] = None,
    intrinsics: Annotated[
        Path | None, typer.Option(help="With --grid: camera file (JSON) of the colour stream.")
    ] = None,
) -> None:
    """Fit corrections to hand-measured fruit, or depth scale and lens to a printed grid."""
    from cucumbervision.accuracy.calibration_file import write_site_calibration
    from cucumbervision.accuracy.own_truth import read_measured
    from cucumbervision.accuracy.site_calibration import calibrate_camera, calibrate_lengths
    from cucumbervision.accuracy.truth import read_truth
    from cucumbervision.capture.readers import open_source
    from cucumbervision.capture.source import ReadOptions
    from cucumbervision.errors import CalibrationError

    if grid is not None:
        captures = (ref.load() for ref in open_source(measurements, ReadOptions(intrinsics)))
        site = calibrate_camera(captures, grid / 1000, name or out.stem)
    elif truth is None:
        raise CalibrationError(
            "nothing to calibrate with",
            source="calibrate",
            remedy="give a CSV of hand-measured lengths, or captures of a grid and --grid in mm",
        )
    else:
        measured = read_measured(measurements)
        site = calibrate_lengths(measured, read_truth(truth), name or out.stem)
    write_site_calibration(out, site)
    _show(site, out)


def _show(site: SiteCalibration, out: Path) -> None:
    from cucumbervision.accuracy.statistics import ReportTable
    from cucumbervision.cli.console import print_table, screen

    console = screen(150)
    if site.depth_scale is not None:
        scale = site.depth_scale
        console.print(
            f"Depth scale {scale.value:.5f} ± {scale.standard_error:.5f} (standard error) from "
            f"{scale.captures} captures of a grid; depth is divided by it.",
            soft_wrap=True,
        )
    if site.lens is not None:
        numbers = ", ".join(f"{coefficient:.4f}" for coefficient in site.lens.coefficients)
        console.print(
            f"Lens (k1, k2, p1, p2, k3): {numbers}; {site.lens.residual_px:.2f} px remain.",
            soft_wrap=True,
        )
    if site.corrections:
        title = "Corrections, tried on fruit left out of the fit"
        rows = [vars(entry) | _formula_and_interval(entry) for entry in site.corrections]
        print_table(console, ReportTable.of_records(title, _CORRECTIONS, rows))
    for entry in site.corrections:
        text = f"{entry.method} ({entry.truth_kind}): {entry.reason}"
        console.print(f"{text}; interval: {entry.interval.reason}", soft_wrap=True)
    console.print(f"{site.tag} is in {out}", soft_wrap=True)


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


def _formula_and_interval(entry: CorrectionEntry) -> dict[str, object]:
    half = entry.interval.half_width
    offset = f" {100 * entry.offset_m:+.2f} cm" if entry.form == "scale+offset" else ""
    formula = "none" if entry.form == "none" else f"x {entry.scale:.4f}{offset}"
    return {"formula": formula, "half_width_percent": None if half is None else 100 * half}
