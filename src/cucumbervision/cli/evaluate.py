"""`cucumbervision evaluate`: how good the lengths are, and what the networks see."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["app"]

app = typer.Typer(
    name="evaluate",
    help="Hold lengths, or the networks, against ground truth.",
    no_args_is_help=True,
)


@app.callback()
def _evaluate() -> None:
    """Hold lengths, or the networks, against ground truth."""


@app.command()
def lengths(
    measurements: Annotated[
        Path,
        typer.Argument(help="Folder of a `measure` run, or its measurements.json or .csv."),
    ],
    truth: Annotated[
        Path,
        typer.Argument(
            help="CSV: capture, fruit, length_cm, kind (thread, centreline or chord); optionally "
            "specimen, repeat, length_1_cm, length_2_cm …"
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the report.")],
) -> None:
    """Hold every method against hand-measured lengths: a table here, a report in the folder."""
    from cucumbervision.cli.truth_console import evaluate_and_show

    evaluate_and_show(measurements, truth, out)
