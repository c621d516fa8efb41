"""`cucumbervision evaluate`: how good the lengths are, and what the networks see."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    name="evaluate",
    help="Compare lengths, or the networks, with ground truth.",
    no_args_is_help=True,
)


@app.callback()
def _evaluate() -> None:
    """Compare lengths, or the networks, with ground truth."""


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
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the tables.")],
) -> None:
    """Compare every method with hand-measured lengths: a table, and CSV files in the folder."""
    from cucumbervision.accuracy.measured import read_measured
    from cucumbervision.accuracy.own_truth import evaluate_lengths, scores_table, write_own_truth
    from cucumbervision.accuracy.truth import read_truth
    from cucumbervision.cli.console import print_table, screen

    measured, table = read_measured(measurements), read_truth(truth)
    found = evaluate_lengths(measured, table)
    console = screen(150)
    print_table(console, scores_table(found.scores))
    for note in found.notes:
        console.print(note, soft_wrap=True, markup=False)
    write_own_truth(found, out, measured, table)
    console.print(f"The tables are in {out}/", soft_wrap=True, markup=False)
