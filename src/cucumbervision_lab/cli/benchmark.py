"""`cucumbervision benchmark`: accuracy of every method on fruit of known length."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def benchmark(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for records and results; rerun to resume.")
    ] = Path("benchmark"),
    quick: Annotated[
        bool,
        typer.Option("--quick", help="Run a few captures without networks, in about a minute."),
    ] = False,
    stress: Annotated[int, typer.Option(min=0, help="Number of fruit in the stress set.")] = 2000,
    workers: Annotated[int, typer.Option(min=1, help="Number of processes.")] = 2,
    learn_intervals: Annotated[
        Path | None,
        typer.Option(help="Fit the interval models, write them to this file and exit."),
    ] = None,
    learn_fruit: Annotated[
        int, typer.Option(min=50, help="Number of stress-set fruit for fitting the intervals.")
    ] = 1600,
    learn_set: Annotated[
        Path | None,
        typer.Option(help="Set from 'synth' with depth, for the intervals of network masks."),
    ] = None,
) -> None:
    """Measure simulated fruit of known length by every method.

    Includes the paper's 48 captures and five validation fruit with exact, disturbed and perceived
    masks, and a stress set: tilted, bent, occluded, distant, wet and sunlit fruit.
    """
    from cucumbervision_lab.benchmark.records import require_extra

    require_extra()  # before an hour of measuring
    from cucumbervision_lab.benchmark import run
    from cucumbervision_lab.benchmark.report import benchmark_tables, write_tables
    from cucumbervision_lab.cli.screen import part_bars, show, show_tables

    if learn_intervals is not None:
        from cucumbervision_lab.detection.learn import learn_intervals as learn

        if learn_set is None:
            raise typer.BadParameter("--learn-intervals requires --learn-set, a set from 'synth'")
        with part_bars() as report:
            book = learn(learn_intervals, out, learn_fruit, learn_set, workers, report)
        for key, model in book.models.items():
            band = model.bands[""]
            show(f"{key}: {band.count} readings, bias {100 * band.bias:+.2f} %")
        show(f"{book.fruit} fruit, level {book.level:.0%}, in {learn_intervals}")
        return
    plan = run.BenchmarkOptions(quick, stress, workers)
    with part_bars() as report:
        readings = run.run_benchmark(plan, out, report)
    tables = benchmark_tables(readings)
    show_tables(tables)
    show(f"Results: {write_tables(out / 'benchmark.json', run.provenance(plan), tables)}")
