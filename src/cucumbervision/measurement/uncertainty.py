"""How sure a length is: an interval at a stated level, from what is known at run time.

A fit's own standard deviation is only as honest as its model, so it is scaled by what simulated
fruit of known length showed: log sigma = c0 + sum of ck fk over features of the measurement, then
conformal quantiles of error / sigma on fruit that took no part in the fit of sigma
(normalised split-conformal prediction; Lei et al. 2018, Romano et al. 2019). Calibration fruit and
test fruit are disjoint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike, NDArray

__all__ = ["IntervalModel", "conformal_quantile", "fit_interval_model"]

FLOOR = 1e-4  # of the length: nothing is surer than a tenth of a per mille


@dataclass(frozen=True)
class IntervalModel:
    """Uncertainty of one method's length, relative to it.

    Parameters
    ----------
    method : str
        The method.
    level : float
        The level at which `quantile` was taken.
    features : tuple of str
        Names of the features.
    weights : tuple of float
        c0 and one weight a feature, of log(relative sigma).
    bias : float
        Median log error on the calibration fruit.
    low_quantile, high_quantile : float
        Conformal quantiles of (log error - bias) / sigma to either side, each missed by half
        of 1 - level; a method that reads short has a long lower side. Scale known.
    count : int
        Calibration fruit behind the quantiles.
    """

    method: str
    level: float
    features: tuple[str, ...]
    weights: tuple[float, ...]
    bias: float
    low_quantile: float
    high_quantile: float
    count: int

    def sigma(self, values: Mapping[str, float]) -> float:
        """Give the relative sigma for one measurement's features; missing ones count as 0."""
        row = np.array([1.0, *(values.get(name, 0.0) for name in self.features)])
        return float(np.exp(np.clip(row @ np.array(self.weights), np.log(FLOOR), 0.0)))

    def interval(
        self, length_m: float, values: Mapping[str, float], scale_sd: float = 0.0
    ) -> tuple[float, float]:
        """Give the interval of a length.

        Parameters
        ----------
        length_m : float
            The length in metres.
        values : mapping of str to float
            The measurement's features.
        scale_sd : float
            Relative standard deviation of the camera's depth scale; 0 once a bar of known length
            was measured.

        Returns
        -------
        low_m, high_m : float

        Examples
        --------
        >>> model = IntervalModel("M6", 0.9, (), (np.log(0.01),), 0.0, 2.0, 2.0, 500)
        >>> [round(x, 4) for x in model.interval(0.2, {})]
        [0.196, 0.204]
        """
        sigma = self.sigma(values)
        scale = _normal_quantile(self.level) * scale_sd
        low, high = (
            float(np.hypot(q * sigma, scale)) for q in (self.low_quantile, self.high_quantile)
        )
        # error = log(measured / true) lies in [bias - low, bias + high].
        return (
            length_m * float(np.exp(-self.bias - high)),
            length_m * float(np.exp(-self.bias + low)),
        )


def _normal_quantile(level: float) -> float:
    from scipy.stats import norm

    return float(norm.ppf(0.5 + level / 2))


def conformal_quantile(scores: ArrayLike, level: float) -> float:
    """Give the finite-sample conformal quantile: the ceil((n + 1) level)-th smallest score.

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
    bias = float(np.median(error[first]))
    weights = _log_linear(np.abs(error[first] - bias), columns[first])
    sigma = np.exp(np.clip(columns @ weights, np.log(FLOOR), 0.0))
    scores = ((error - bias) / sigma)[~first]
    side = (1 + level) / 2
    return IntervalModel(
        method,
        level,
        names,
        tuple(float(w) for w in weights),
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
