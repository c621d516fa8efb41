"""How the interval of a length is learnt: sigma on half of the fruit, quantiles on the others."""

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
    feature_group,
)
from cucumbervision.measurement.result import IntervalBasis

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

SMALLEST_GROUP = 100  # readings in either half: fewer go with all the others

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
)

RAW_FEATURES = ("distance_m", "holes", "log_pixels")

# Fruit of which an end is hidden are read short, by far; the others err the more differently from
# what the fit says itself, the less sure it is.
TUBE_EDGES = (("end_hidden", (0.5,)), ("log_sd", (float(np.log(0.01)), float(np.log(0.03)))))


def conformal_quantile(scores: ArrayLike, level: float) -> float:
    """Return the finite-sample conformal quantile: the ceil((n + 1) level)-th smallest score.

    Parameters
    ----------
    scores : array_like of float, shape (N,)
        Nonconformity scores of calibration fruit.
    level : float
        Wanted coverage.

    Raises
    ------
    ValueError
        If N is too small for the level: N < level / (1 - level).

    Examples
    --------
    >>> conformal_quantile(range(1, 11), 0.8)
    9.0
    """
    ordered = np.sort(np.asarray(scores, float))
    rank = int(np.ceil((len(ordered) + 1) * level - 1e-9))
    if rank > len(ordered):
        need = int(np.ceil(level / (1 - level) - 1e-9))
        raise ValueError(f"{len(ordered)} fruit cannot carry a level of {level}: {need} are needed")
    return float(ordered[rank - 1])


def fit_interval_model(
    method: str,
    errors: ArrayLike,
    features: Mapping[str, ArrayLike],
    fruit: ArrayLike,
    level: float = 0.90,
    edges: tuple[tuple[str, tuple[float, ...]], ...] = (),
    seed: int = 0,
) -> IntervalModel:
    """Fit sigma on one half of the fruit and take the quantile on the other.

    Parameters
    ----------
    method : str
        The method's name.
    errors : array_like of float, shape (N,)
        log(measured / true), depth scale known: small ones are the relative error, large ones
        never reach past nothing.
    features : mapping of str to array_like of float, shape (N,)
        What is known of each measurement at run time.
    fruit : array_like of str, shape (N,)
        The fruit of each; a fruit's captures stay in one half.
    level : float
        Wanted coverage.
    edges : tuple of (str, tuple of float), optional
        Features by which fruit are grouped, and where one group ends.
    seed : int
        Seed of the split.

    Returns
    -------
    IntervalModel

    Raises
    ------
    ValueError
        If a half is too small.
    """
    error, names = np.asarray(errors, float), tuple(features)
    columns = np.stack(
        [np.ones_like(error), *(np.asarray(features[n], float) for n in names)], axis=1
    )
    first = _halves(np.asarray(fruit), seed)
    weights = _log_linear(np.abs(error[first] - np.median(error[first])), columns[first])
    sigma = np.exp(np.clip(columns @ weights, np.log(FLOOR), 0.0))
    bands = {"": _band(error, sigma, first, level)}
    rows = [dict(zip(names, row[1:], strict=True)) for row in columns]
    groups = np.array([feature_group(edges, row) for row in rows])
    for group in np.unique(groups) if edges else ():
        inside = groups == group
        if min((inside & first).sum(), (inside & ~first).sum()) >= SMALLEST_GROUP:
            bands[str(group)] = _band(error[inside], sigma[inside], first[inside], level)
    kept = tuple(float(w) for w in weights)
    return IntervalModel(method, level, names, kept, bands, edges)


def _band(
    error: NDArray[np.float64], sigma: NDArray[np.float64], first: NDArray[np.bool_], level: float
) -> Band:
    bias = float(np.median(error[first]))
    scores = ((error - bias) / sigma)[~first]
    side = (1 + level) / 2
    return Band(
        bias,
        max(conformal_quantile(-scores, side), 0.0),
        max(conformal_quantile(scores, side), 0.0),
        len(scores),
    )


def _halves(fruit: NDArray[np.str_], seed: int) -> NDArray[np.bool_]:
    names = np.unique(fruit)
    chosen = np.random.default_rng(seed).permutation(len(names)) < len(names) / 2
    return np.asarray(chosen[np.searchsorted(names, fruit)])


def _log_linear(size: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit log |error| by the features, robustly (Huber), with a slight ridge."""
    from scipy.optimize import least_squares

    target = np.log(np.maximum(size, FLOOR))
    ridge = 1e-3 * np.sqrt(len(target))

    def residuals(weights: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([columns @ weights - target, ridge * weights[1:]])

    start = np.zeros(columns.shape[1])
    start[0] = np.median(target)
    found: NDArray[np.float64] = least_squares(residuals, start, loss="huber", f_scale=1.0).x
    return found


def write_interval_models(path: Path, models: IntervalModels) -> None:
    """Write interval models as JSON, numbers to nine digits.

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
