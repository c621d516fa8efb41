"""The whole benchmark: protocol, stress set, intervals, experiments, report."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from cucumbervision._version import __version__
from cucumbervision.about import installed_versions
from cucumbervision.accuracy.records import Masks
from cucumbervision.measurement.intervals import shipped_interval_models, write_interval_models
from cucumbervision_lab.benchmark import experiments
from cucumbervision_lab.benchmark.interval_fit import fit_interval_models, with_intervals
from cucumbervision_lab.benchmark.measure_case import CaseOptions
from cucumbervision_lab.benchmark.protocol import paper_cases, stress_cases, validation_cases
from cucumbervision_lab.benchmark.runner import run_cases

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from cucumbervision.accuracy.records import Record
    from cucumbervision.accuracy.table import Table
    from cucumbervision.measurement.intervals import IntervalModels
    from cucumbervision_lab.benchmark.protocol import Case

__all__ = ["BenchmarkPlan", "learn_intervals", "plan_cases", "run_benchmark"]

# Interval models are learnt on case numbers that no benchmark reaches.
LEARN_FIRST = 1_000_000
CARROT = "rgbd/carrot_realsense_1280"


@dataclass(frozen=True)
class BenchmarkPlan:
    """What one run of the benchmark does.

    Parameters
    ----------
    quick : bool
        A few captures, no networks, no experiments: for regression guards.
    stress : int
        Independent fruit of the stress set.
    workers : int
        Processes.
    outsiders : bool
        Whether other people's tools run where they are installed.
    data : Path, optional
        The folder of real captures, for the experiment on the carrot frames.
    """

    quick: bool = False
    stress: int = 2000
    workers: int = 2
    outsiders: bool = True
    data: Path | None = None


def plan_cases(plan: BenchmarkPlan) -> tuple[list[Case], list[Case]]:
    """Give the cases of the protocol and of the stress set."""
    if plan.quick:
        return [*paper_cases(7), *validation_cases()[:2]], stress_cases(min(plan.stress, 8))
    return [*paper_cases(), *validation_cases()], stress_cases(plan.stress)


def run_benchmark(
    plan: BenchmarkPlan, out: Path, report: Callable[[str, int, int], None] | None = None
) -> tuple[list[Record], dict[str, Table]]:
    """Measure everything that the plan asks; what is already in `out` is not measured again.

    Parameters
    ----------
    plan : BenchmarkPlan
        What to do.
    out : Path
        Gets a file of records for each part.
    report : callable, optional
        Called with a part's name, how many of its cases were just finished and how many it has.

    Returns
    -------
    records : list of Record
        With their intervals in `details['intervals']`.
    tables : dict of str to Table
        The experiments, by name.
    """
    protocol, stress = plan_cases(plan)
    both = (Masks.EXACT, Masks.DISTURBED)
    kinds = both if plan.quick else (*both, Masks.PERCEIVED)

    def run(name: str, cases: list[Case], options: CaseOptions) -> list[Record]:
        total = len(cases)
        tell = None if report is None else (lambda count: report(name, count, total))
        return run_cases(cases, options, out / f"{name}.jsonl", plan.workers, tell)

    outsiders = plan.outsiders and not plan.quick
    records = run("protocol", protocol, CaseOptions(kinds, outsiders))
    records += run("stress", stress, CaseOptions(both))
    book = shipped_interval_models()
    records = [_covered(record, book) for record in records]
    if plan.quick:
        return records, {}
    tables = {
        "wrong intrinsics": experiments.wrong_intrinsics(),
        "burst": experiments.burst_sizes(
            lambda size: run(
                f"burst-{size}", paper_cases(), CaseOptions((Masks.EXACT,), frames=size)
            )
        ),
        "prompts": experiments.sam_prompts(
            lambda prompt: run(
                f"prompt-{prompt.replace('+', '-')}",
                protocol,
                CaseOptions((Masks.PERCEIVED,), prompt=prompt),
            )
        ),
        "selectors": experiments.selectors(records),
        "conventions": experiments.length_conventions(records),
    }
    if plan.data is not None:
        tables["carrot intrinsics"] = experiments.carrot_intrinsics(plan.data / CARROT)
    return records, tables


def _covered(record: Record, book: IntervalModels) -> Record:
    found = with_intervals(record, book)
    details: dict[str, Any] = {**record.details, "intervals": found}
    for key, name in (("M6", "interval"), ("M6 thread", "thread_interval")):
        if key in found:
            details[f"{name}_low_m"], details[f"{name}_high_m"] = found[key]["known"]
            details[f"{name}_basis"] = "simulated"
    return replace(record, details=details)


def learn_intervals(
    file: Path, out: Path, fruit: int, workers: int, report: Callable[[str, int, int], None] | None
) -> IntervalModels:
    """Learn the book of intervals anew, on fruit that no benchmark measures.

    Half of the records come from exact outlines and half from disturbed ones, so that the fit's
    own view of the outline's roughness tells which is which.

    Parameters
    ----------
    file : Path
        Where the book goes.
    out : Path
        Keeps the records, so that a later run resumes.
    fruit : int
        How many fruit.
    workers : int
        Processes.
    report : callable, optional
        As in `run_benchmark`.
    """
    cases = stress_cases(fruit, first=LEARN_FIRST)
    tell = None if report is None else (lambda count: report("learning", count, fruit))
    options = CaseOptions((Masks.EXACT, Masks.DISTURBED))
    book = fit_interval_models(run_cases(cases, options, out / "learning.jsonl", workers, tell))
    write_interval_models(file, book)
    return book


def provenance(plan: BenchmarkPlan) -> dict[str, Any]:
    """Say by what a benchmark was run."""
    return {
        "software": f"cucumbervision {__version__}",
        "versions": installed_versions(),
        "stress fruit": plan.stress,
        "quick": plan.quick,
    }
