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
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

__all__ = ["Band", "IntervalModel", "conformal_quantile", "fit_interval_model"]

SMALLEST_GROUP = 100  # readings in either half: fewer go with all the others
FLOOR = 1e-4  # of the length: nothing is surer than a tenth of a per mille


@dataclass(frozen=True)
class Band:
    """What calibration fruit of one group showed.

    Parameters
    ----------
    bias : float
        Median log error.
    low_quantile, high_quantile : float
        Conformal quantiles of (log error - bias) / sigma to either side, each missed by half
        of 1 - level; a method that reads short has a long lower side. Scale known.
    count : int
        Calibration readings behind the quantiles.
    """

    bias: float
    low_quantile: float
    high_quantile: float
    count: int


@dataclass(frozen=True)
class IntervalModel:
    """Uncertainty of one method's length, relative to it.

    Parameters
    ----------
    method : str
        The method.
    level : float
        The level at which the quantiles were taken.
    features : tuple of str
        Names of the features.
    weights : tuple of float
        c0 and one weight a feature, of log(relative sigma).
    bands : dict of str to Band
        By group: '' for all, and '0-1' and so on for groups by `edges`.
    edges : tuple of (str, tuple of float)
        Features by which fruit are grouped, and where one group ends (Mondrian conformal
        prediction; Vovk et al. 2005): within each group the interval covers by itself.
    """

    method: str
    level: float
    features: tuple[str, ...]
    weights: tuple[float, ...]
    bands: dict[str, Band]
    edges: tuple[tuple[str, tuple[float, ...]], ...] = ()

    def sigma(self, values: Mapping[str, float]) -> float:
        """Give the relative sigma for one measurement's features; missing ones count as 0."""
        row = np.array([1.0, *(values.get(name, 0.0) for name in self.features)])
        return float(np.exp(np.clip(row @ np.array(self.weights), np.log(FLOOR), 0.0)))

    def band(self, values: Mapping[str, float]) -> Band:
        """Give the group's band, or that of all where the group was too small to have one."""
        return self.bands.get(_group(self.edges, values), self.bands[""])

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
        >>> bands = {"": Band(0.0, 2.0, 2.0, 500)}
        >>> model = IntervalModel("M6", 0.9, (), (np.log(0.01),), bands)
        >>> [round(x, 4) for x in model.interval(0.2, {})]
        [0.196, 0.204]
        """
        sigma, band = self.sigma(values), self.band(values)
        scale = _normal_quantile(self.level) * scale_sd
        low = float(np.hypot(band.low_quantile * sigma, scale))
        high = float(np.hypot(band.high_quantile * sigma, scale))
        # error = log(measured / true) lies in [bias - low, bias + high].
        return (
            length_m * float(np.exp(-band.bias - high)),
            length_m * float(np.exp(-band.bias + low)),
        )


def _group(edges: Sequence[tuple[str, Sequence[float]]], values: Mapping[str, float]) -> str:
    return "-".join(
        str(int(np.searchsorted(limits, values.get(name, 0.0)))) for name, limits in edges
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
    groups = np.array([_group(edges, row) for row in rows])
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
