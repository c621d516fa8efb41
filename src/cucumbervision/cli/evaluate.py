"""`cucumbervision evaluate`: how good the lengths are, on one's own fruit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["app"]

app = typer.Typer(
    name="evaluate",
    help="Hold measurements against one's own ground truth.",
    no_args_is_help=True,
)


@app.callback()
def _evaluate() -> None:
    """Hold measurements against one's own ground truth."""


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
