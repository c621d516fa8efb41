"""Run the benchmark in parallel with resume, and fit interval models."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from cucumbervision._version import __version__
from cucumbervision.about import installed_versions
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.intervals import (
    PERCEIVED,
    SCALE_SD,
    IntervalModel,
    IntervalModels,
    has_no_interval,
    raw_features,
)
from cucumbervision.measurement.methods import AVAILABLE
from cucumbervision.pipeline.finders import Finder, make_finder
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision_lab.benchmark.cases import paper_cases, stress_cases, validation_cases
from cucumbervision_lab.benchmark.interval_fit import (
    PERCEIVED_TUBE_EDGES,
    RAW_EDGES,
    RAW_FEATURES,
    TUBE_EDGES,
    TUBE_FEATURES,
    fit_interval_model,
)
from cucumbervision_lab.benchmark.measure_case import CaseOptions, measure_case
from cucumbervision_lab.benchmark.records import Masks, append_record, read_records, readings_frame
from cucumbervision_lab.datasets.labels import ticked
from cucumbervision_lab.processes import each_done

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from cucumbervision_lab.benchmark.cases import Case
    from cucumbervision_lab.benchmark.records import LengthRecord

TRUTH_OF = {
    **dict.fromkeys(AVAILABLE, "centreline_m"),
    "M6 thread": "thread_m",
    "M6 chord": "chord_m",
}
"""Column of the true length that the interval of each method should cover."""

KEYS = tuple(TRUTH_OF)

_LEVEL = 0.90  # nominal coverage


def _reading_features(reading: pd.Series[Any]) -> dict[str, float] | None:
    """Return the interval features of a reading; None if it has no interval.

    Parameters
    ----------
    reading : Series
        A row of `readings_frame` with one of the methods in `KEYS`.
    """
    if np.isnan(reading["length_m"]):
        return None
    tube, mask = (reading.get(name) for name in ("m6_features", "mask_features"))
    mask = mask if isinstance(mask, dict) else {}
    if has_no_interval(mask):
        return None
    if reading["method"].startswith("M6"):
        return tube | mask if isinstance(tube, dict) else None
    return raw_features(reading["length_m"], reading["distance_m"], reading["fill"]) | mask


def fit_interval_models(readings: pd.DataFrame) -> IntervalModels:
    """Fit an interval model for each method, with known depth scale.

    Parameters
    ----------
    readings : DataFrame
        Readings of calibration fruit from `readings_frame`; must not include test fruit.

    Raises
    ------
    ValueError
        If there are too few fruit for a coverage of 90 %.
    """
    models = {}
    by_networks = readings["masks"] == Masks.PERCEIVED
    for part, behind in ((readings[~by_networks], ""), (readings[by_networks], PERCEIVED)):
        for key, truth in TRUTH_OF.items() if len(part) else ():
            rows = part[(part["method"] == key) & part[truth].notna()]
            models[key + behind] = _fitted_model(key + behind, rows, truth)
    return IntervalModels(_LEVEL, models, readings["fruit"].nunique())


def _fitted_model(key: str, rows: pd.DataFrame, truth: str) -> IntervalModel:
    tube, tube_edges = key.startswith("M6"), TUBE_EDGES
    if key.endswith(PERCEIVED):
        tube_edges = PERCEIVED_TUBE_EDGES
    names, edges = (TUBE_FEATURES, tube_edges) if tube else (RAW_FEATURES, RAW_EDGES)
    entries = [
        entry for entry in rows.apply(_reading_features, axis=1).items() if entry[1] is not None
    ]
    rows = rows.loc[[label for label, _ in entries]]
    errors = np.log(rows["length_m"] / rows[truth]).to_numpy()
    features = {
        name: np.array([reading.get(name, 0.0) for _, reading in entries]) for name in names
    }
    # Fruit of one picture are not independent samples.
    fruit = rows["case"].str.partition("#")[0].to_numpy()
    return fit_interval_model(key, errors, features, fruit, _LEVEL, edges)


def with_intervals(
    readings: pd.DataFrame, book: IntervalModels, *, scale_known: bool = True
) -> pd.DataFrame:
    """Add the columns `low_m` and `high_m` to readings, NaN without an interval.

    If the scale is unknown, lengths are multiplied by the camera's depth scale, and the intervals
    include the scale uncertainty.

    Parameters
    ----------
    readings : DataFrame
        Readings from `readings_frame` with unique row labels.
    book : IntervalModels
        Interval models.
    scale_known : bool
        Whether the depth scale is exact, as after calibration.
    """
    ends = {}
    for label, reading in readings[readings["method"].isin(KEYS)].iterrows():
        features = _reading_features(reading)
        if features is not None:
            scale = 1.0 if scale_known else reading["depth_scale"]
            length_m = reading["length_m"] * scale
            more_sd = 0.0 if scale_known else SCALE_SD
            interval = book.interval(reading["method"], length_m, features, more_sd)
            ends[label] = interval or (np.nan, np.nan)
    bounds = pd.DataFrame.from_dict(ends, "index", columns=["low_m", "high_m"], dtype=float)
    return readings.join(bounds)


def run_cases(
    cases: Sequence[Case],
    options: CaseOptions,
    records: Path,
    workers: int = 2,
    report: Callable[[int], None] | None = None,
) -> list[LengthRecord]:
    """Measure the cases that are not in the file yet, and return the records of all cases.

    Parameters
    ----------
    cases : sequence of Case
        Cases to measure.
    options : CaseOptions
        Measurement options.
    records : Path
        JSON lines file, to which each finished case is appended immediately.
    workers : int
        Number of processes.
    report : callable, optional
        Called with the number of cases finished since the last call.

    Returns
    -------
    list of LengthRecord
        Records of the cases in the order of the file.

    Raises
    ------
    CucumberVisionError
        If the file was written with other options or by another version.
    """
    done = _resume(records, options)
    missing = [c for c in cases if not _measured(c, options, done)]
    if report is not None and len(missing) < len(cases):
        report(len(cases) - len(missing))
    for batch in ticked(each_done(partial(_measure, options), missing, workers), report):
        for record in batch:
            append_record(records, record)
    names = {case.name for case in cases}
    return [r for r in read_records([records]) if r.case in names] if records.exists() else []


def _measure(options: CaseOptions, case: Case) -> list[LengthRecord]:
    find = package_finder().find if Masks.PERCEIVED in options.masks else None
    return measure_case(case, options, None if find is None else lambda c: find(c).instances)


@lru_cache
def package_finder() -> Finder:
    """Return what finds fruit with the package's networks, loaded once in each process."""
    return make_finder(MeasureOptions(instances="models"))


def _measured(case: Case, options: CaseOptions, done: set[tuple[str, str, str]]) -> bool:
    return all((str(case.suite), case.name, str(kind)) in done for kind in options.masks)


def _resume(records: Path, options: CaseOptions) -> set[tuple[str, str, str]]:
    """Create the file, or check that it has the same options and version."""
    stamp = {"version": __version__, "options": asdict(options)}
    mark = hashlib.sha256(json.dumps(stamp, sort_keys=True).encode()).hexdigest()
    head = records.with_suffix(".run")
    records.parent.mkdir(parents=True, exist_ok=True)
    if not records.exists():
        head.write_text(mark + "\n")
        return set()
    if not head.exists() or head.read_text().strip() != mark:
        raise CucumberVisionError(
            "was written with other options or by another version",
            source=records,
            remedy="delete it, or choose another --out",
        )
    return {(r.suite, r.case, r.masks) for r in read_records([records])}


@dataclass(frozen=True)
class BenchmarkOptions:
    """Options of a benchmark run.

    Parameters
    ----------
    quick : bool
        Run only a few captures without networks and baselines, for regression tests.
    stress : int
        Number of fruit in the stress set.
    workers : int
        Number of processes.
    """

    quick: bool = False
    stress: int = 2000
    workers: int = 2


def plan_cases(plan: BenchmarkOptions) -> tuple[list[Case], list[Case]]:
    """Return the cases of the paper's protocol and of the stress set."""
    if plan.quick:
        return [*paper_cases(7), *validation_cases()[:2]], stress_cases(min(plan.stress, 8))
    return [*paper_cases(), *validation_cases()], stress_cases(plan.stress)


def run_benchmark(
    plan: BenchmarkOptions, out: Path, report: Callable[[str, int, int], None] | None = None
) -> pd.DataFrame:
    """Run the benchmark, resuming from the records in `out`.

    Parameters
    ----------
    plan : BenchmarkOptions
        Options.
    out : Path
        Folder for the records.
    report : callable, optional
        Called with the name of the step, the number of cases finished since the last call, and
        their total.

    Returns
    -------
    DataFrame
        All readings from `readings_frame`.
    """
    protocol, stress = plan_cases(plan)
    exact_and_disturbed = (Masks.EXACT, Masks.DISTURBED)
    kinds = exact_and_disturbed if plan.quick else (*exact_and_disturbed, Masks.PERCEIVED)

    def run(name: str, cases: list[Case], options: CaseOptions) -> pd.DataFrame:
        total = len(cases)
        tell = None if report is None else (lambda count: report(name, count, total))
        return readings_frame(run_cases(cases, options, out / f"{name}.jsonl", plan.workers, tell))

    parts = [run("protocol", protocol, CaseOptions(kinds, baselines=not plan.quick))]
    if stress:
        parts.append(run("stress", stress, CaseOptions(exact_and_disturbed)))
    return pd.concat(parts, ignore_index=True)


def provenance(plan: BenchmarkOptions) -> dict[str, Any]:
    """Return the options and versions of a benchmark run."""
    return {
        "software": f"cucumbervision {__version__}",
        "versions": installed_versions(),
        "stress fruit": plan.stress,
        "quick": plan.quick,
    }
