"""`cucumbervision benchmark`: every method's accuracy on fruit of known length."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def benchmark(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for records and report; kept, it resumes.")
    ] = Path("benchmark"),
    quick: Annotated[
        bool, typer.Option("--quick", help="A few captures, no networks: a minute.")
    ] = False,
    stress: Annotated[int, typer.Option(min=0, help="Independent fruit of the stress set.")] = 2000,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    learn_intervals: Annotated[
        Path | None,
        typer.Option(help="Learn the intervals anew into this file, and do nothing else."),
    ] = None,
    learn_fruit: Annotated[
        int, typer.Option(min=50, help="Fruit of the stress set's kind to learn intervals from.")
    ] = 1600,
    learn_set: Annotated[
        Path | None,
        typer.Option(help="A set by 'synth' with depth: what the networks see of it teaches too."),
    ] = None,
) -> None:
    """Measure simulated fruit of known length by every method and write a report.

    The paper's 48 captures and five validation fruit, with exact, disturbed and perceived masks,
    and a stress set of independent fruit: tilted, bent, half hidden, far, wet, in the sun.
    """
    from cucumbervision_lab.benchmark import run
    from cucumbervision_lab.benchmark.report import (
        glance_table,
        paper_table,
        write_benchmark_report,
    )
    from cucumbervision_lab.cli.screen import part_bars, show, show_tables

    if learn_intervals is not None:
        from cucumbervision_lab.detection.learn_intervals import learn_intervals as learn

        if learn_set is None:
            raise typer.BadParameter("--learn-intervals needs --learn-set, a set by 'synth'")
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
    beside = paper_table(readings)
    show_tables([*([beside] if beside else ()), glance_table(readings)])
    written = write_benchmark_report(readings, out, provenance=run.provenance(plan))
    show(f"The report is {written}")
