"""Fit length intervals by cross-conformal prediction."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.measurement.intervals import (
    FLOOR,
    Band,
    IntervalModel,
    IntervalModels,
    feature_groups,
)
from cucumbervision.measurement.result import IntervalBasis

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

_SMALLEST_GROUP = 60  # readings; smaller groups use the enclosing group

_FOLDS = 5

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
    """Fit sigma, and quantiles of the normalised errors of held-out fruit.

    Sigma is fitted in five folds, and the quantiles are taken over the errors of the held-out folds
    (cross-conformal prediction; Vovk 2015). The final sigma is fitted on all fruit.

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
    """
    error, names = np.asarray(errors, float), tuple(features)
    if missing:
        error = error + np.asarray(features[missing], float)
    columns = np.stack(
        [np.ones_like(error), *(np.asarray(features[n], float) for n in names)], axis=1
    )
    rows = [dict(zip(names, row[1:], strict=True)) for row in columns]
    groups = [feature_groups(edges, row) for row in rows]
    members = {
        group: np.array([group in members for members in groups])
        for group in sorted({group for members in groups for group in members})
    }
    fold, sigma = _folds(np.asarray(fruit), seed), np.empty_like(error)
    for held_out in (fold == k for k in range(_FOLDS)):
        sigma[held_out] = _sigma(
            columns[held_out], _log_linear(_size(error[~held_out]), columns[~held_out])
        )
    bands = {
        group: _band(error[chosen], sigma[chosen], level)
        for group, chosen in members.items()
        if not group or chosen.sum() >= smallest_group
    }
    weights = tuple(map(float, _log_linear(_size(error), columns)))
    return IntervalModel(method, level, names, weights, bands, edges, missing)


def _size(error: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.abs(error - np.median(error)))


def _sigma(columns: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.exp(np.clip(columns @ weights, np.log(FLOOR), 0.0)))


def _band(error: NDArray[np.float64], sigma: NDArray[np.float64], level: float) -> Band:
    bias = float(np.median(error))
    scores = (error - bias) / sigma
    side = (1 + level) / 2
    return Band(
        bias,
        max(conformal_quantile(-scores, side), 0.0),
        max(conformal_quantile(scores, side), 0.0),
        len(scores),
    )


def _folds(fruit: NDArray[np.str_], seed: int) -> NDArray[np.intp]:
    names, place = np.unique(fruit, return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(names))
    return np.asarray(order[place] % _FOLDS)


def _log_linear(size: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit log |error| as a linear function of the features (Huber loss, weak ridge)."""
    from scipy.optimize import least_squares

    target = np.log(np.maximum(size, FLOOR))
    ridge = 1e-3 * np.sqrt(len(target))

    def residuals(weights: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([columns @ weights - target, ridge * weights[1:]])

    start = np.zeros(columns.shape[1])
    start[0] = np.median(target)
    coefficients: NDArray[np.float64] = least_squares(residuals, start, loss="huber", f_scale=1.0).x
    return coefficients


def write_interval_models(path: Path, models: IntervalModels) -> None:
    """Write interval models as JSON with nine significant digits.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from cucumbervision.measurement.intervals import read_interval_models
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "models.json"
    >>> bands = {"": Band(0.001, 1.5, 1.7, 700)}
    >>> model = IntervalModel("M6", 0.9, ("tilt",), (-4.5, 0.5), bands, (("tilt", (0.25,)),))
    >>> models = IntervalModels(0.9, {"M6": model}, 700)
    >>> write_interval_models(path, models)
    >>> read_interval_models(path) == models
    True
    """
    content = {
        "basis": str(IntervalBasis.SIMULATED),
        "level": models.level,
        "fruit": models.fruit,
        "models": [_rounded(asdict(model)) for model in models.models.values()],
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.9g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value
