"""What `detect` looks like on screen: a progress bar, a summary, and the failures."""

from __future__ import annotations

from statistics import fmean, median
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cucumbervision.cli.console import progress_bar, show_failures
from cucumbervision.pipeline.detect import detect_inputs

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from cucumbervision.pipeline.detect import DetectOptions, DetectResult

__all__ = ["run_and_show", "summary_table"]


def run_and_show(inputs: Sequence[str], out: Path, options: DetectOptions, *, quiet: bool) -> int:
    """Detect fruit in pictures, show progress and a summary, and return the exit code.

    Progress and failures go to the standard error, the summary to the standard output.
    """
    errors = Console(stderr=True, quiet=quiet, highlight=False)
    with progress_bar(errors) as bar:
        task = bar.add_task("detecting", total=None)
        result = detect_inputs(
            inputs, out, options, lambda done, total: bar.update(task, completed=done, total=total)
        )
    if not quiet:
        console = Console(highlight=False)
        console.print(summary_table(result))
        written = "results.json, images.json" + (" and overlays/" if options.overlays else "")
        console.print(f"{written} are in {out}/", soft_wrap=True, markup=False)
    show_failures(result.failures, out)
    return result.exit_code


def summary_table(result: DetectResult) -> Table:
    """Lay out how many pictures, how many fruit, how sure, how quick, and by which networks."""
    scores = [score for one in result.pictures for score in one.scores]
    seconds = [one.seconds for one in result.pictures]
    empty = sum(not one.scores for one in result.pictures)
    table = Table(show_header=False)
    without = f", {empty} without fruit" if empty else ""
    table.add_row("pictures", f"{len(result.pictures)}{without}")
    table.add_row("fruit", str(len(scores)))
    table.add_row("mean score", f"{fmean(scores):.2f}" if scores else "")
    # The first picture also waits for SAM to load.
    table.add_row("seconds a picture", f"{median(seconds):.2f} (median)" if seconds else "")
    if result.skipped:
        table.add_row("no pictures, skipped", str(result.skipped))
    networks = ", ".join(f"{m['name']} on {m['runtime']}" for m in result.models)
    table.add_row("networks", escape(networks))
    return table
