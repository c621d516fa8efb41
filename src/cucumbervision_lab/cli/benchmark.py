"""`cucumbervision benchmark`: how good every method is, on fruit whose lengths are known."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["benchmark"]


def benchmark(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for records and report; kept, it resumes.")
    ] = Path("benchmark"),
    quick: Annotated[
        bool, typer.Option("--quick", help="A few captures, no networks: a minute.")
    ] = False,
    stress: Annotated[int, typer.Option(min=0, help="Independent fruit of the stress set.")] = 2000,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    data: Annotated[
        Path | None, typer.Option(help="Folder of real captures, for what is checked on them.")
    ] = None,
    learn_intervals: Annotated[
        Path | None,
        typer.Option(help="Learn the intervals anew into this file, and do nothing else."),
    ] = None,
    learn_fruit: Annotated[
        int, typer.Option(min=50, help="Fruit to learn the intervals from.")
    ] = 1600,
) -> None:
    """Measure simulated fruit of known length by every method and write a report.

    The paper's 48 captures and five validation fruit, with exact, disturbed and perceived masks,
    and a stress set of independent fruit: tilted, bent, half hidden, far, wet, in the sun.
    """
    from cucumbervision_lab.benchmark.benchmark import BenchmarkPlan
    from cucumbervision_lab.cli.benchmark_console import learn, run_and_report

    if learn_intervals is not None:
        learn(learn_intervals, out, learn_fruit, workers)
        return
    run_and_report(BenchmarkPlan(quick, stress, workers, data=data), out)
