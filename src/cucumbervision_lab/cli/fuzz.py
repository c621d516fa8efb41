"""`cucumbervision fuzz`: damaged files for every reader."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from cucumbervision.accuracy.page import Table
    from cucumbervision_lab.robustness.fuzz import FuzzResult


def fuzz(
    targets: Annotated[
        list[str] | None,
        typer.Argument(metavar="[READER]...", help="By the beginnings of their names; all."),
    ] = None,
    inputs: Annotated[int, typer.Option("--inputs", "-n", min=1, help="How many.")] = 10_000,
    seed: Annotated[int, typer.Option(min=0, help="The same seed damages alike.")] = 1,
    minutes: Annotated[
        float | None, typer.Option(min=0, help="Begin nothing more after this time.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the files that were found.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Also write the figures here.")
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="Add the run to this file, and print the sum of all runs in it."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but finds.")] = False,
) -> None:
    """Read damaged files of every kind; only named errors may come of them.

    Each input is one valid file with one to three faults, read in a process that may hold 2 GB and
    compute for 10 s on it. A find is an error without a name of ours, too much memory or time, or
    the end of the process; exit code 1 tells that there was one.
    """
    from cucumbervision_lab.cli.screen import show, show_tables, ticking
    from cucumbervision_lab.robustness.fuzz import find_targets
    from cucumbervision_lab.robustness.fuzz import fuzz as run
    from cucumbervision_lab.robustness.fuzz_log import add_to_log, as_json

    with ticking("reading damaged files", inputs, quiet=quiet) as tick:
        seconds = None if minutes is None else 60 * minutes
        result = run(inputs, seed, find_targets(targets or []), out, seconds=seconds, tick=tick)
    if not quiet:
        show_tables([_by_target(result)])
        tried = sum(result.tried.values())
        show(
            f"{tried:,} inputs in {result.seconds:.0f} s, {tried / result.seconds:.0f} a second; "
            f"{sum(result.refused.values()):,} refused by name, {sum(result.found.values())} finds "
            f"at {len(result.found)} places"
        )
    for place, count in result.found.most_common():
        show(f"{count} x {place} (input {result.finds[place][0].number})", error=True)
    if log is not None:
        together = add_to_log(result, log)
        show(
            f"{log}: {together.runs} runs, {together.inputs:,} inputs, "
            f"{together.refused:,} refused by name, {together.finds} finds, "
            f"{together.seconds / 60:.0f} min; fewest: {together.fewest}"
        )
    if json_file is not None:
        json_file.write_text(as_json(result) + "\n", encoding="utf-8")
    raise typer.Exit(1 if result.found else 0)


def _by_target(result: FuzzResult) -> Table:
    from cucumbervision.accuracy.page import Table

    finds = dict.fromkeys(result.tried, 0)
    for place, count in result.found.items():
        finds[place.split(":")[0]] += count
    rows = [
        (name, tried, result.refused[name], finds[name])
        for name, tried in sorted(result.tried.items())
    ]
    heads = ["reader", "inputs", "refused by name", "finds"]
    return Table.of("Damaged files", heads, rows, "")
