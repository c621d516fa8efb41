"""A figure with what it rests on: how many values, of how many scenes, and its interval."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.accuracy.statistics import binomial_interval
from cucumbervision.capture.files import json_value

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Sequence

    from numpy.typing import ArrayLike, NDArray

__all__ = ["LEVEL", "Estimate", "estimate", "scene_weights", "share"]

LEVEL = 0.95
_RESAMPLES = 2000
_FEWEST_SCENES = 2


@dataclass(frozen=True)
class Estimate:
    """A figure and its interval.

    Parameters
    ----------
    value : float
        The figure; NaN where there is nothing to judge.
    low, high : float
        Its 95 % interval, whole scenes drawn anew; NaN below two scenes.
    count : int
        How many values it is of.
    scenes : int
        Of how many scenes these are.
    """

    value: float
    low: float
    high: float
    count: int
    scenes: int

    def as_json(self) -> dict[str, float | int | None]:
        """Give it for JSON, None in place of NaN."""
        interval = {"value": self.value, "low": self.low, "high": self.high}
        return {**json_value(interval), "n": self.count, "scenes": self.scenes}


def estimate(
    values: ArrayLike, scenes: Sequence[Hashable], quantile: float | None = None
) -> Estimate:
    """Give a mean, or a quantile, with its interval by scene.

    Parameters
    ----------
    values : array_like of float, shape (N,)
        One a fruit, a detection or an end.
    scenes : sequence of hashable
        The scene of each.
    quantile : float, optional
        0 to 1; the mean without it.

    Returns
    -------
    Estimate
        The interval is the percentile bootstrap's: scenes are drawn with replacement.

    Examples
    --------
    >>> found = estimate([1.0, 1.0, 9.0, 9.0], ["a", "a", "b", "b"])
    >>> found.value, found.low, found.high, found.count, found.scenes
    (5.0, 1.0, 9.0, 4, 2)
    >>> estimate([3.0, 1.0, 2.0], ["a", "a", "a"], quantile=0.5)
    Estimate(value=2.0, low=nan, high=nan, count=3, scenes=1)
    """
    data = np.asarray(values, float)
    names = {name: k for k, name in enumerate(dict.fromkeys(scenes))}
    if not data.size:
        return Estimate(math.nan, math.nan, math.nan, 0, 0)
    member = np.array([names[name] for name in scenes])
    statistic = _mean if quantile is None else _weighted_quantile(quantile)
    order = np.argsort(data, kind="stable")
    data, member = data[order], member[order]
    value = statistic(data, np.ones(len(data)))
    if len(names) < _FEWEST_SCENES:
        return Estimate(value, math.nan, math.nan, len(data), len(names))
    weights = scene_weights(len(names), _RESAMPLES)
    if quantile is None:
        size = weights @ np.bincount(member, minlength=len(names))
        drawn = weights @ np.bincount(member, data, len(names)) / np.maximum(size, 1)
    else:
        drawn = np.array([statistic(data, w[member]) for w in weights])
    low, high = np.nanpercentile(drawn, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    return Estimate(value, float(low), float(high), len(data), len(names))


def share(hits: ArrayLike, scenes: Sequence[Hashable]) -> Estimate:
    """Give a share with its interval by scene.

    Where all are hits, or none, drawing scenes anew shows no spread; the interval is then the
    exact one of as many independent trials as there are scenes.

    Examples
    --------
    >>> found = share([True] * 6, ["a", "b", "c", "d", "e", "e"])
    >>> found.value, round(found.low, 3), found.high
    (1.0, 0.478, 1.0)
    """
    values = np.asarray(hits, float)
    found = estimate(values, scenes)
    if found.scenes < _FEWEST_SCENES or found.value not in (0.0, 1.0):
        return found
    low, high = binomial_interval(int(found.value) * found.scenes, found.scenes, LEVEL)
    return Estimate(found.value, low, high, found.count, found.scenes)


def scene_weights(scenes: int, resamples: int, seed: int = 0) -> NDArray[np.float64]:
    """Give how often each scene is drawn in each resample, shape (resamples, scenes)."""
    drawn = np.random.default_rng(seed).multinomial(scenes, np.full(scenes, 1 / scenes), resamples)
    return drawn.astype(float)


def _mean(data: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    total = weights.sum()
    return float(weights @ data / total) if total else math.nan


def _weighted_quantile(
    quantile: float,
) -> Callable[[NDArray[np.float64], NDArray[np.float64]], float]:
    """Give the quantile of sorted data counted by whole weights, as numpy's linear one."""

    def find(data: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
        upto = np.cumsum(weights)
        if not upto[-1]:
            return math.nan
        place = quantile * (upto[-1] - 1)
        first, second = np.searchsorted(upto, [np.floor(place), np.ceil(place)], side="right")
        part = place - np.floor(place)
        return float((1 - part) * data[first] + part * data[second])

    return find
