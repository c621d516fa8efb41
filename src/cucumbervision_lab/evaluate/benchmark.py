"""Run the benchmark in parallel with resume, and fit interval models."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from cucumbervision._version import __version__
from cucumbervision.errors import MissingExtraError
from cucumbervision.methods import intervals
from cucumbervision.methods.result import IntervalBasis
from cucumbervision.methods.table import AVAILABLE
from cucumbervision.run.finders import Finder
from cucumbervision.run.options import MeasureOptions
from cucumbervision_lab.arrays import Array, Progress
from cucumbervision_lab.evaluate.cases import Case, paper_cases, stress_cases, validation_cases
from cucumbervision_lab.evaluate.measure_case import Masks, Row, measure_case, readings_frame
from cucumbervision_lab.processes import kept_rows

_SMALLEST_GROUP = 60  # readings; smaller groups use the enclosing group

_FOLDS = 5
_QUANTILE, _TREES, _RATE, _SMALLEST_LEAF = 0.9, 60, 0.08, 40  # of the trees

_MASK_FEATURES = ("certainty", "own_mask", "goes_on", "ends_disagree")

TUBE_FEATURES = (
    "log_sd",
    "log_outline",
    "tilt",
    "tilt_steep",
    "hidden",
    "distance_m",
    "holes",
    "unexplained",
    "log_pixels",
    "end_hidden",
    "end_on",
    "poor_fit",
    "closed",
    "flare",
    "girth",
    *_MASK_FEATURES,
)

RAW_FEATURES = ("distance_m", "holes", "log_pixels", *_MASK_FEATURES)

# Fruit that extend out of sight are measured much too short. Where no flag shows that, fruit are
# the more often incomplete the less background is seen beyond their ends.
RAW_EDGES: tuple[tuple[str, tuple[float, ...]], ...] = (("goes_on", (0.5,)),)

TUBE_EDGES: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("end_hidden", (0.5,)),
    ("hidden", (0.1,)),
    ("closed", (0.5, 0.8)),
)

PERCEIVED_TUBE_EDGES: tuple[tuple[str, tuple[float, ...]], ...] = (
    *RAW_EDGES,
    ("closed", (0.5, 0.8)),
)


def conformal_quantile(scores: ArrayLike, level: float) -> float:
    """Return the finite-sample conformal quantile, the ceil((n + 1) level)-th smallest score.

    Parameters
    ----------
    scores : array_like of float, shape (N,)
        Nonconformity scores of calibration fruit.
    level : float
        Nominal coverage.

    Raises
    ------
    ValueError
        If N is too small for the level, N < level / (1 - level).

    Examples
    --------
    >>> conformal_quantile(range(1, 11), 0.8)
    9.0
    """
    ordered = np.sort(np.asarray(scores, float))
    rank = int(np.ceil((len(ordered) + 1) * level - 1e-9))
    if rank > len(ordered):
        need = int(np.ceil(level / (1 - level) - 1e-9))
        raise ValueError(f"{len(ordered)} fruit are too few for a level of {level}: need {need}")
    return float(ordered[rank - 1])


def fit_interval_model(
    method: str,
    errors: ArrayLike,
    features: Mapping[str, ArrayLike],
    fruit: ArrayLike,
    level: float = 0.90,
    edges: tuple[tuple[str, tuple[float, ...]], ...] = (),
    seed: int = 0,
    *,
    smallest_group: int = _SMALLEST_GROUP,
    missing: str = "",
) -> intervals.IntervalModel:
    """Fit the spreads of errors, and the quantiles of held-out errors relative to them.

    Spreads are fitted in five folds, and the quantiles are taken over the errors of the held-out
    folds (cross-conformal prediction; Vovk 2015). The final spreads are fitted on all fruit.

    Parameters
    ----------
    method : str
        Name of the method.
    errors : array_like of float, shape (N,)
        log(measured / true) with known depth scale.
    features : mapping of str to array_like of float, shape (N,)
        Features of each measurement that are available at run time.
    fruit : array_like of str, shape (N,)
        Fruit or frame of each measurement; all of its readings are in one fold.
    level : float
        Nominal coverage.
    edges : tuple of (str, tuple of float), optional
        Features that define groups, and the boundaries between the groups.
    seed : int
        Random seed of the folds.
    smallest_group : int
        Readings that a group needs for quantiles of its own; a smaller one uses those of the
        group around it.
    missing : str
        Feature that holds how much longer than measured a fruit is expected to be, as a logarithm.

    Returns
    -------
    IntervalModel
        Fitted model.

    Raises
    ------
    ValueError
        If there are too few fruit for the level.
    MissingExtraError
        If scikit-learn is not installed.
    """
    error, names = np.asarray(errors, float), tuple(features)
    if missing:
        error = error + np.asarray(features[missing], float)
    columns = np.array([np.asarray(features[name], float) for name in names]).reshape(
        len(names), len(error)
    )
    rows = [dict(zip(names, row, strict=True)) for row in columns.T]
    groups = [intervals.feature_groups(edges, row) for row in rows]
    members = {
        group: np.array([group in members for members in groups])
        for group in sorted({group for members in groups for group in members})
    }
    spreads = _held_out_spreads(error, columns.T, _folds(np.asarray(fruit), seed))
    bands = {
        group: _band(error[chosen], spreads[:, chosen], level)
        for group, chosen in members.items()
        if not group or chosen.sum() >= smallest_group
    }
    below, above = _fitted_sides(error, columns.T)
    return intervals.IntervalModel(method, level, names, below, above, bands, edges, missing)


def _held_out_spreads(error: Array, rows: Array, fold: NDArray[np.intp]) -> Array:
    """Return the spreads below and above, (2, N), each by trees that did not know the fruit."""
    spreads = np.empty((2, len(error)))
    for held_out in (fold == k for k in range(_FOLDS)):
        sides = _fitted_sides(error[~held_out], rows[~held_out])
        for side, trees in enumerate(sides):
            spreads[side, held_out] = [intervals.spread(trees, row) for row in rows[held_out]]
    return spreads


def _fitted_sides(error: Array, rows: Array) -> tuple[intervals.Trees, intervals.Trees]:
    """Return the trees of errors below and above 0."""
    below, above = (
        fitted_trees(
            np.log(np.maximum(side + intervals.LEAST_SPREAD, intervals.LEAST_SPREAD)), rows
        )
        for side in (-error, error)
    )
    return below, above


def fitted_trees(target: Array, rows: Array) -> intervals.Trees:
    """Fit a quantile of a value by its features, by gradient boosting.

    Parameters
    ----------
    target : ndarray of float64, shape (N,)
        The values.
    rows : ndarray of float64, shape (N, F)
        Features of each.

    Raises
    ------
    MissingExtraError
        If scikit-learn is not installed.
    """
    if not rows.shape[1]:
        return intervals.Trees(float(np.quantile(target, _QUANTILE)))
    try:
        from sklearn.ensemble import GradientBoostingRegressor
    except ImportError as error:
        raise MissingExtraError("scikit-learn", "benchmark") from error
    boosted = GradientBoostingRegressor(
        loss="quantile",
        alpha=_QUANTILE,
        n_estimators=_TREES,
        learning_rate=_RATE,
        max_depth=2,
        min_samples_leaf=_SMALLEST_LEAF,
        random_state=0,
    ).fit(rows, target)
    parts = [_parts_of(estimator.tree_) for estimator in boosted.estimators_[:, 0]]
    features, limits, leaves = zip(*parts, strict=True)
    return intervals.Trees(float(boosted.init_.constant_.item()), features, limits, leaves)


def _parts_of(tree: Any) -> tuple[Any, Any, Any]:
    """Return features, limits and leaves of a fitted tree; a node that it lacks splits nothing."""

    def below_and_above(node: int) -> tuple[int, int]:
        split = tree.children_left[node] >= 0
        return (tree.children_left[node], tree.children_right[node]) if split else (node, node)

    inner = (0, *below_and_above(0))
    features = tuple(max(int(tree.feature[node]), 0) for node in inner)
    limits = tuple(float(tree.threshold[node]) for node in inner)
    leaves = [leaf for node in inner[1:] for leaf in below_and_above(node)]
    return features, limits, tuple(_RATE * float(tree.value[leaf].item()) for leaf in leaves)


def _band(error: Array, spreads: Array, level: float) -> intervals.Band:
    short, long = -error / spreads[0], error / spreads[1]
    side = (1 + level) / 2
    low, high = conformal_quantile(short, side), conformal_quantile(long, side)
    # Where all misses lie on one side, that side takes both halves of the miss rate.
    if high <= 0:
        return intervals.Band(conformal_quantile(short, level), 0.0, len(error))
    if low <= 0:
        return intervals.Band(0.0, conformal_quantile(long, level), len(error))
    return intervals.Band(low, high, len(error))


def _folds(fruit: NDArray[np.str_], seed: int) -> NDArray[np.intp]:
    names, place = np.unique(fruit, return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(names))
    return np.asarray(order[place] % _FOLDS)


def write_interval_models(path: Path, models: intervals.IntervalModels) -> None:
    """Write interval models as JSON with six significant digits, a model to a line.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from cucumbervision.methods.intervals import (
    ...     Band, IntervalModel, IntervalModels, Trees, read_interval_models)
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "models.json"
    >>> tilted = Trees(-4.5, ((0, 0, 0),), ((0.5, 0.2, 0.9),), ((-0.1, 0.0, 0.1, 0.2),))
    >>> bands, edges = {"": Band(1.5, 1.7, 700)}, (("tilt", (0.25,)),)
    >>> model = IntervalModel("M6", 0.9, ("tilt",), tilted, Trees(-4.0), bands, edges)
    >>> models = IntervalModels(0.9, {"M6": model}, 700)
    >>> write_interval_models(path, models)
    >>> read_interval_models(path) == models
    True
    """
    head = {"basis": str(IntervalBasis.SIMULATED), "level": models.level, "fruit": models.fruit}
    lines = [json.dumps(_rounded(asdict(model))) for model in models.models.values()]
    text = json.dumps(head)[:-1] + ', "models": [\n' + ",\n".join(lines) + "\n]}\n"
    path.write_text(text, encoding="utf-8")


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value


TRUTH_OF = {
    **dict.fromkeys(AVAILABLE, "centreline_m"),
    "M6 thread": "thread_m",
    "M6 chord": "chord_m",
}
"""Column of the true length that the interval of each method should cover."""

KEYS = tuple(TRUTH_OF)

_LEVEL = 0.90  # nominal coverage


def interval_features(reading: pd.Series[Any]) -> dict[str, float] | None:
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
    if intervals.has_no_interval(mask):
        return None
    if reading["method"].startswith("M6"):
        return tube | mask if isinstance(tube, dict) else None
    return (
        intervals.raw_features(reading["length_m"], reading["distance_m"], reading["fill"]) | mask
    )


def fit_interval_models(readings: pd.DataFrame) -> intervals.IntervalModels:
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
    for part, behind in (
        (readings[~by_networks], ""),
        (readings[by_networks], intervals.PERCEIVED),
    ):
        for key, truth in TRUTH_OF.items() if len(part) else ():
            rows = part[(part["method"] == key) & part[truth].notna()]
            models[key + behind] = _fitted_model(key + behind, rows, truth)
    return intervals.IntervalModels(_LEVEL, models, readings["fruit"].nunique())


def _fitted_model(key: str, rows: pd.DataFrame, truth: str) -> intervals.IntervalModel:
    tube, tube_edges = key.startswith("M6"), TUBE_EDGES
    if key.endswith(intervals.PERCEIVED):
        tube_edges = PERCEIVED_TUBE_EDGES
    names, edges = (TUBE_FEATURES, tube_edges) if tube else (RAW_FEATURES, RAW_EDGES)
    entries = [
        entry for entry in rows.apply(interval_features, axis=1).items() if entry[1] is not None
    ]
    rows = rows.loc[[label for label, _ in entries]]
    errors = np.log(rows["length_m"] / rows[truth]).to_numpy()
    features = {
        name: np.array([reading.get(name, 0.0) for _, reading in entries]) for name in names
    }
    # Fruit of one picture are not independent samples.
    fruit = rows["case"].str.partition("#")[0].to_numpy()
    return fit_interval_model(key, errors, features, fruit, _LEVEL, edges)


def run_cases(
    cases: Sequence[Case],
    masks: Sequence[Masks],
    records: Path,
    workers: int = 2,
    report: Progress | None = None,
) -> list[Row]:
    """Measure the cases that are not recorded yet, and return the rows of all cases.

    Parameters
    ----------
    cases : sequence of Case
        Cases to measure.
    masks : sequence of Masks
        Kinds of masks.
    records : Path
        JSON lines file, to which each finished case is appended immediately. Version and masks
        are added to its name, so that others measure anew.
    workers : int
        Number of processes.
    report : callable, optional
        Called with the number of cases finished since the last call.

    Returns
    -------
    list of Row
        Rows of the cases in their order.
    """
    stamp = crc32(json.dumps({"version": __version__, "masks": masks}).encode())
    file = records.with_name(f"{records.stem}-{stamp:08x}.jsonl")
    jobs = {case.name: case for case in cases}
    return kept_rows(file, jobs, partial(_measure, masks), workers, report)


def _measure(masks: Sequence[Masks], case: Case) -> list[Row]:
    find = package_finder().find if Masks.PERCEIVED in masks else None
    return measure_case(case, masks, None if find is None else lambda c: find(c).instances)


@lru_cache
def package_finder() -> Finder:
    """Return what finds fruit with the package's networks, loaded once in each process."""
    return Finder(MeasureOptions(instances="models"))


def run_benchmark(
    out: Path,
    *,
    quick: bool = False,
    stress: int = 2000,
    workers: int = 2,
    report: Callable[[str, int, int], None] | None = None,
) -> pd.DataFrame:
    """Run the benchmark, resuming from the records in `out`.

    Parameters
    ----------
    out : Path
        Folder for the records.
    quick : bool
        Run only a few captures without networks and baselines, for regression tests.
    stress : int
        Number of fruit in the stress set.
    workers : int
        Number of processes.
    report : callable, optional
        Called with the name of the step, the number of cases finished since the last call, and
        their total.

    Returns
    -------
    DataFrame
        All readings from `readings_frame`.
    """
    exact_and_disturbed = (Masks.EXACT, Masks.DISTURBED)
    protocol = [*paper_cases(), *validation_cases()]
    kinds: tuple[Masks, ...] = (*exact_and_disturbed, Masks.PERCEIVED)
    if quick:
        protocol, kinds = [*paper_cases(7), *validation_cases()[:2]], exact_and_disturbed
        stress = min(stress, 8)

    def run(name: str, cases: list[Case], masks: Sequence[Masks]) -> pd.DataFrame:
        tell = None if report is None else (lambda count: report(name, count, len(cases)))
        return readings_frame(run_cases(cases, masks, out / f"{name}.jsonl", workers, tell))

    parts = [run("protocol", protocol, kinds)]
    if stress:
        parts.append(run("stress", stress_cases(stress), exact_and_disturbed))
    return pd.concat(parts, ignore_index=True)
