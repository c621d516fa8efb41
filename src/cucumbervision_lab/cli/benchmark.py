"""`cucumbervision benchmark`: how good every method is, on fruit whose lengths are known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import pandas as pd

    from cucumbervision.accuracy.table import Table


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
    experiments: Annotated[
        bool, typer.Option(help="Answer the side questions too: bursts, prompts, intrinsics.")
    ] = True,
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
    from cucumbervision_lab.benchmark.report import write_benchmark_report
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
    plan = run.BenchmarkPlan(quick, stress, workers, data=data, experiments=experiments)
    with part_bars() as report:
        readings, answers = run.run_benchmark(plan, out, report)
    show_tables(_summary_tables(readings))
    origin = run.provenance(plan)
    written = write_benchmark_report(readings, out, experiments=answers, provenance=origin)
    show(f"The report is {written}")


_SUMMARY = {
    "method": "method",
    "measured_percent": "measured %:.0",
    "mape_percent": "MAPE %",
    "median_percent": "median %",
    "worst_percent": "worst %:.1",
    "bias_percent": "bias %:+.2",
}


def _summary_tables(readings: pd.DataFrame) -> list[Table]:
    """Return one table a suite and kind of mask: every method against the centreline."""
    from cucumbervision.accuracy.table import Table
    from cucumbervision.measurement.result import LengthDefinition
    from cucumbervision_lab.benchmark.report import parts_of
    from cucumbervision_lab.report.length_tables import against, method_metrics

    tables = []
    for suite, masks, part in parts_of(readings):
        found = method_metrics(against(part, LengthDefinition.CENTRELINE))
        rows = [
            vars(one) | {"method": method, "measured_percent": 100 * one.measured}
            for method, one in found.items()
        ]
        title = f"{suite} captures, {masks} masks ({part['case'].nunique()})"
        tables.append(Table.of_records(f"{title}: error against the centreline", _SUMMARY, rows))
    return tables
