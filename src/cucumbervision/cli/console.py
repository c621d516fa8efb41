"""Terminal output of commands: progress bars, tables of results, failures."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from statistics import fmean
from textwrap import shorten
from typing import Any

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress
from rich.table import Table

from cucumbervision.accuracy import statistics
from cucumbervision.crop.grades import GradingTraits, grade
from cucumbervision.crop.profiles import CropProfile, load_profile
from cucumbervision.fruit.instance import MaskSource
from cucumbervision.methods.flags import flag_remarks, is_lower_bound
from cucumbervision.methods.result import LengthDefinition
from cucumbervision.run.batch import count_captures
from cucumbervision.run.detect import DetectResult, detect_inputs
from cucumbervision.run.measurer import Failure
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import BatchOptions, RunResult, measure_inputs

_MOST_ROWS = 40
_WIDTH = 120
_LONGEST_NOTE = 400
_SIMULATED = "some of these captures are simulated"


def screen(width: int = _WIDTH) -> Console:
    """Return the console for results.

    A file or pipe has no width, and the default of 80 columns would cut the tables.
    """
    return plain_console(width=None if Console().is_terminal else width)


def plain_console(**how: Any) -> Console:
    """Return a console that prints names unchanged: no markup, no emoji, no highlighting.

    Examples
    --------
    >>> plain_console().print("[/x] [red]a[/red] :tada:")
    [/x] [red]a[/red] :tada:
    """
    return Console(highlight=False, markup=False, emoji=False, **how)


def columns_table(title: str | None, text_columns: Sequence[str], *right: str) -> Table:
    """Return an empty table with left-aligned columns, then right-aligned ones."""
    table = Table(*text_columns, title=title, title_justify="left")
    for head in right:
        table.add_column(head, justify="right")
    return table


def print_table(console: Console, figures: statistics.ReportTable) -> None:
    """Print a report's table, and its comment below."""
    printed = Table(title=figures.title, title_justify="left")
    for head, numeric in zip(figures.heads, figures.numeric, strict=True):
        printed.add_column(head, justify="right" if numeric else "left")
    for row in figures.text_rows():
        printed.add_row(*row)
    console.print(printed, markup=False, emoji=False)
    if figures.comment:
        console.print(figures.comment, soft_wrap=True, markup=False, style="dim")


@contextmanager
def stopping_gently() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was pressed; a second one interrupts."""
    pressed = False

    def press(*_: object) -> None:
        nonlocal pressed
        pressed = True
        sys.stderr.write(
            "\nstopping after the current captures; press Ctrl-C again to stop immediately\n"
        )
        signal.signal(signal.SIGINT, before)

    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, press)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)


def measure_and_show(
    inputs: Sequence[Path],
    out: Path,
    options: MeasureOptions,
    batch: BatchOptions,
    *,
    quiet: bool = False,
    profile: str = "long-cucumber",
    by_method: bool = False,
) -> int:
    """Measure, show progress and results, and return the exit code.

    Progress, notes and failures go to the standard error, results to the standard output.
    """
    errors = plain_console(stderr=True, quiet=quiet)
    total = count_captures(inputs, options.reading) if errors.is_terminal else None
    with progress_bar(errors) as bar, stopping_gently() as is_cancelled:
        task = bar.add_task("measuring", total=total)
        batch = replace(batch, is_cancelled=is_cancelled)
        result = measure_inputs(inputs, out, options, lambda _: bar.advance(task), batch)
    for note in result.notes:  # complete in measurements.json
        short = shorten(note, _LONGEST_NOTE, placeholder=" …")
        errors.print(short, soft_wrap=True)
    if not quiet:
        console = screen()
        console.print(
            _results_table(result, options.length, load_profile(profile), by_method=by_method)
        )
        console.print(f"{_closing_line(result)}\nTables and images are in {out}/", soft_wrap=True)
    show_failures(result.failures, result.out)
    if result.interrupted:
        errors.print("interrupted; rerun the command to resume", soft_wrap=True)
    return result.exit_code


def detect_and_show(
    inputs: Sequence[str], out: Path, options: MeasureOptions, *, quiet: bool
) -> int:
    """Detect fruit in images, show progress and a summary, and return the exit code.

    Progress and failures go to the standard error, the summary to the standard output.
    """
    errors = plain_console(stderr=True, quiet=quiet)
    with progress_bar(errors) as bar:
        task = bar.add_task("detecting", total=None)
        result = detect_inputs(
            inputs, out, options, lambda done, total: bar.update(task, completed=done, total=total)
        )
    if not quiet:
        console = plain_console()
        console.print(summary_table(result))
        written = "results.json, images.json and overlays/"
        console.print(f"{written} are in {out}/", soft_wrap=True)
    show_failures(result.failures, out)
    return result.exit_code


def progress_bar(console: Console) -> Progress:
    """Return the progress bar of a long command.

    It is shown on terminals only, and removed at the end.
    """
    hidden = console.quiet or not console.is_terminal
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    return Progress(*columns, console=console, disable=hidden, transient=True)


def _results_table(
    result: RunResult, length: LengthDefinition, profile: CropProfile, *, by_method: bool
) -> Table:
    """Return the results as a table of 80 columns; `by_method` adds a column for each method."""
    rows: list[Mapping[str, Any]] = list(islice(result.each_row(), _MOST_ROWS))
    ran = [f"m{k}" for k in range(1, 7) if any(r[f"m{k}_cm"] is not None for r in rows)]
    methods = ran if by_method else []
    table = Table(title=f"Measured fruit, {length} in cm", title_justify="left")
    table.add_column("capture", overflow="fold")
    table.add_column("fruit", justify="right")
    table.add_column("length", justify="right", style="bold", no_wrap=True)
    table.add_column("90 % interval", justify="right", no_wrap=True)
    for method in methods:
        table.add_column(method.upper(), justify="right")
    table.add_column("class, remarks", overflow="fold")
    for row in rows:
        name, number = row["capture"], str(row["fruit"])
        lengths = [_number(row[f"{method}_cm"]) for method in methods]
        remarks = _remarks(row, profile)
        table.add_row(name, number, _length(row), _interval(row), *lengths, remarks)
    if result.summary.fruit > _MOST_ROWS:
        table.caption = f"and {result.summary.fruit - _MOST_ROWS} more in measurements.csv"
    return table


def _remarks(row: Mapping[str, Any], profile: CropProfile) -> str:
    """Return a fruit's class and its flags in words, or why it was not measured."""
    if row["length_cm"] is None:
        return f"not measured: {row['reason']}"
    graded = grade(GradingTraits.from_row(row), profile)
    parts = [graded.words, flag_remarks(row["flags"])]
    if row["length_kind"] not in set(LengthDefinition):
        parts.append(f"{row['length_kind']} by {row['method']}")
    return "; ".join(filter(None, parts))


def _length(row: Mapping[str, Any]) -> str:
    bound = row["length_cm"] is not None and is_lower_bound(row["flags"].split())
    return f"≥ {_number(row['length_cm'])}" if bound else _number(row["length_cm"])


def _interval(row: Mapping[str, Any]) -> str:
    if row["interval_low_cm"] is None:
        return ""
    text = f"{row['interval_low_cm']:.1f} – {row['interval_high_cm']:.1f}"
    # The interval of a raw chord or arc is that of another length.
    return text if row["interval_of"] == row["length_kind"] else f"{text} ({row['interval_of']})"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _closing_line(result: RunResult) -> str:
    """Return a summary line: fruit measured, sources of masks, and simulated captures."""
    summary = result.summary
    line = f"{summary.measured} of {summary.fruit} fruit measured in {summary.captures} captures"
    if result.before:
        line = f"{line}, {result.before} of them by an earlier run"
    masks = [(MaskSource(name).words, count) for name, count in summary.masks.items() if name]
    if masks:
        line = f"{line}; masks by {', '.join(f'{words} {count}' for words, count in masks)}"
    return f"{line}; {_SIMULATED}." if summary.simulated else f"{line}."


def show_failures(failures: Sequence[Failure], out: Path | None = None) -> None:
    """Print failures to the standard error, one a line; `out` holds them as a table, too."""
    if not failures:
        return
    console = plain_console(stderr=True)
    also = f", also in {out}/failures.csv" if out and (out / "failures.csv").exists() else ""
    console.print(f"{len(failures)} failed{also}:", soft_wrap=True)
    for failure in failures:
        console.print(f"  {failure.message}", soft_wrap=True)


def summary_table(result: DetectResult) -> Table:
    """Return a table with the numbers of images and fruit, the mean score and the networks."""
    scores = [fruit["score"] for picture in result.pictures for fruit in picture.fruit]
    empty = sum(not picture.fruit for picture in result.pictures)
    table = Table(show_header=False)
    without = f", {empty} without fruit" if empty else ""
    table.add_row("pictures", f"{len(result.pictures)}{without}")
    table.add_row("fruit", str(len(scores)))
    table.add_row("mean score", f"{fmean(scores):.2f}" if scores else "")
    if result.skipped:
        table.add_row("no images, skipped", str(result.skipped))
    networks = ", ".join(f"{m['name']} on {m['runtime']}" for m in result.models)
    table.add_row("networks", networks)
    return table
