"""Fit length intervals by cross-conformal prediction."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import MissingExtraError
from cucumbervision.measurement.intervals import (
    LEAST_SPREAD,
    Band,
    IntervalModel,
    IntervalModels,
    Trees,
    feature_groups,
    spread,
)
from cucumbervision.measurement.result import IntervalBasis

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

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

# Fruit that extend out of sight are measured much too short. Where no flag tells that, fruit are
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
) -> IntervalModel:
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
    groups = [feature_groups(edges, row) for row in rows]
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
    return IntervalModel(method, level, names, below, above, bands, edges, missing)


def _held_out_spreads(
    error: NDArray[np.float64], rows: NDArray[np.float64], fold: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return the spreads below and above, (2, N), each by trees that did not know the fruit."""
    spreads = np.empty((2, len(error)))
    for held_out in (fold == k for k in range(_FOLDS)):
        sides = _fitted_sides(error[~held_out], rows[~held_out])
        for side, trees in enumerate(sides):
            spreads[side, held_out] = [spread(trees, row) for row in rows[held_out]]
    return spreads


def _fitted_sides(error: NDArray[np.float64], rows: NDArray[np.float64]) -> tuple[Trees, Trees]:
    """Return the trees of errors below and above 0."""
    below, above = (
        fitted_trees(np.log(np.maximum(side + LEAST_SPREAD, LEAST_SPREAD)), rows)
        for side in (-error, error)
    )
    return below, above


def fitted_trees(target: NDArray[np.float64], rows: NDArray[np.float64]) -> Trees:
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
        return Trees(float(np.quantile(target, _QUANTILE)))
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
    return Trees(float(boosted.init_.constant_.item()), features, limits, leaves)


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


def _band(error: NDArray[np.float64], spreads: NDArray[np.float64], level: float) -> Band:
    short, long = -error / spreads[0], error / spreads[1]
    side = (1 + level) / 2
    low, high = conformal_quantile(short, side), conformal_quantile(long, side)
    # Where all misses lie on one side, that side takes both halves of the miss rate.
    if high <= 0:
        return Band(conformal_quantile(short, level), 0.0, len(error))
    if low <= 0:
        return Band(0.0, conformal_quantile(long, level), len(error))
    return Band(low, high, len(error))


def _folds(fruit: NDArray[np.str_], seed: int) -> NDArray[np.intp]:
    names, place = np.unique(fruit, return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(names))
    return np.asarray(order[place] % _FOLDS)


def write_interval_models(path: Path, models: IntervalModels) -> None:
    """Write interval models as JSON with six significant digits, a model to a line.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from cucumbervision.measurement.intervals import read_interval_models
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "models.json"
    >>> tilted = Trees(-4.5, ((0, 0, 0),), ((0.5, 0.2, 0.9),), ((-0.1, 0.0, 0.1, 0.2),))
    >>> bands, edges = {"": Band(1.5, 1.7, 700)}, (("tilt", (0.25,)),)
    >>> model = IntervalModel("M6", 0.9, ("tilt",), tilted, Trees(-4.0), bands, edges)
    >>> models = IntervalModels(0.9, {"M6": model}, 700)
    >>> write_interval_models(path, models)
    >>> read_interval_models(path) == models
    True
    """
    head = {
        "basis": str(IntervalBasis.SIMULATED),
        "level": models.level,
        "fruit": models.fruit,
    }
    lines = [json.dumps(_rounded(asdict(model))) for model in models.models.values()]
    text = json.dumps(head)[:-1] + ', "models": [\n' + ",\n".join(lines) + "\n]}\n"
    path.write_text(text, encoding="utf-8")


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value
