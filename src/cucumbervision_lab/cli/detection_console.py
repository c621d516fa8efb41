"""What an evaluation of the networks looks like on screen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from cucumbervision_lab.cli.benchmark_console import progress
from cucumbervision_lab.detection.report import (
    main_tables,
    write_detection_report,
    write_photo_report,
)
from cucumbervision_lab.detection.run import evaluate_detection, evaluate_real_photos
from cucumbervision_lab.detection.summary import summarise
from cucumbervision_lab.detection.tables import photo_table

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision.accuracy.table import Table as Figures
    from cucumbervision_lab.detection.run import DetectionPlan

__all__ = ["evaluate_models_and_show", "evaluate_photos_and_show", "shown"]

WIDTH = 150


def evaluate_models_and_show(plan: DetectionPlan, out: Path) -> None:
    """Evaluate with a progress bar, print the main tables and write the report."""
    with progress() as report:
        result = evaluate_detection(plan, report)
    summary = summarise(result)
    console = _console()
    for table in main_tables(summary, plan.confidence, result.photos):
        _print(console, table)
    page = write_detection_report(result, summary, out)
    console.print(f"The report is {page}", soft_wrap=True, markup=False)


def evaluate_photos_and_show(
    folder: Path,
    out: Path,
    networks: tuple[Path | None, Path | None],
    *,
    runtime: str,
    confidence: float,
    split: str,
) -> None:
    """Evaluate on real photos with a progress bar, print the table and write the figures."""
    with progress() as report:
        result = evaluate_real_photos(
            folder, *networks, runtime=runtime, confidence=confidence, split=split, report=report
        )
    console = _console()
    _print(console, photo_table(result))
    file = write_photo_report(result, out)
    console.print(f"The figures are in {file}", soft_wrap=True, markup=False)


def _console() -> Console:
    return Console(highlight=False, width=None if Console().is_terminal else WIDTH)


def _print(console: Console, table: Figures) -> None:
    console.print(shown(table))
    console.print(table.comment, soft_wrap=True, markup=False, style="dim")


def shown(figures: Figures) -> Table:
    """Set a table of the report out for the screen."""
    table = Table(title=figures.title, title_justify="left")
    for column, numeric in zip(figures.columns, figures.numeric, strict=True):
        table.add_column(column.head, justify="right" if numeric else "left")
    for row in figures.text_rows():
        table.add_row(*row)
    return table
