"""What a benchmark looks like on screen."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from cucumbervision.accuracy.records import Masks, Suite
from cucumbervision.accuracy.tables import Truth, method_rows
from cucumbervision_lab.benchmark import benchmark

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from cucumbervision.accuracy.records import Record

__all__ = ["learn", "progress", "run_and_report", "summary_tables"]

WIDTH = 120


def run_and_report(plan: benchmark.BenchmarkPlan, out: Path) -> None:
    """Run a benchmark with a progress bar, print its main tables, write the report."""
    with progress() as report:
        records, experiments = benchmark.run_benchmark(plan, out, report)
    console = Console(highlight=False, width=WIDTH)
    for table in summary_tables(records):
        console.print(table)
    if not plan.quick:
        from cucumbervision.accuracy.report import write_report
        from cucumbervision.accuracy.sections import Section
        from cucumbervision_lab.benchmark.benchmark_notes import NOTES
        from cucumbervision_lab.benchmark.paper_tables import paper_sections

        tables = tuple(experiments.values())
        written = write_report(
            records,
            out,
            title="CucumberVision benchmark",
            notes={"summary": NOTES["summary"]},
            before=paper_sections(records, NOTES["paper"]),
            after=[Section("Experiments", (), tables)] if tables else [],
            provenance=benchmark.provenance(plan),
        )
        console.print(f"The report is {written}", soft_wrap=True, markup=False)


def learn(file: Path, out: Path, fruit: int, workers: int) -> None:
    """Learn the intervals with a progress bar and say what came of it."""
    with progress() as report:
        book = benchmark.learn_intervals(file, out, fruit, workers, report)
    console = Console(highlight=False, width=WIDTH)
    for key, model in book.models.items():
        band = model.bands[""]
        console.print(f"{key}: {band.count} readings, bias {100 * band.bias:+.2f} %")
    console.print(f"{book.fruit} fruit, level {book.level:.0%}, in {file}", soft_wrap=True)


def summary_tables(records: Sequence[Record]) -> list[Table]:
    """Give one table a suite and kind of mask: every method against the centreline."""
    tables = []
    for suite in Suite:
        for masks in Masks:
            some = [r for r in records if r.suite is suite and r.masks is masks]
            if some:
                tables.append(_table(some, f"{suite} captures, {masks} masks"))
    return tables


def _table(records: Sequence[Record], title: str) -> Table:
    table = Table(title=f"{title} ({len(records)}): error against the centreline", width=WIDTH)
    for head in ("method", "measured %", "MAPE %", "median %", "worst %", "bias %"):
        table.add_column(head, justify="left" if head == "method" else "right")
    for row in method_rows(records, Truth.CENTRELINE):
        m = row.metrics
        table.add_row(
            row.method,
            f"{100 * m.measured:.0f}",
            f"{m.mape_percent:.2f}",
            f"{m.median_percent:.2f}",
            f"{m.worst_percent:.1f}",
            f"{m.bias_percent:+.2f}",
        )
    return table


@contextmanager
def progress() -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar for each part of a long run, on a terminal only.

    Yields
    ------
    callable
        Takes a part's name, how many of it were just finished and how many it has.
    """
    console = Console(stderr=True)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )
    tasks: dict[str, TaskID] = {}

    def report(name: str, count: int, total: int) -> None:
        if name not in tasks:
            tasks[name] = bar.add_task(name, total=total)
        bar.advance(tasks[name], count)

    with bar:
        yield report
