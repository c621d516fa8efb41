"""`cucumbervision calibrate`: a site's correction from hand-measured fruit or a known bar."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["calibrate"]


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
    from cucumbervision.cli.truth_console import calibrate_and_show

    calibrate_and_show(
        measurements,
        truth,
        out,
        name=name or out.stem,
        reference_m=reference_length,
        method=method,
        level=level,
    )
