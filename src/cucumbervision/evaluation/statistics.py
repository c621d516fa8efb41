"""What the numbers of a benchmark can carry: tests and intervals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from numpy.typing import ArrayLike

__all__ = ["Comparison", "binomial_interval", "bootstrap_mean", "compare"]


@dataclass(frozen=True)
class Comparison:
    """A paired comparison of two methods' absolute errors.

    Parameters
    ----------
    p_value : float
        Two-sided Wilcoxon signed-rank test.
    alpha : float
        The level after Bonferroni's correction.
    median_difference : float
        Median of the first's error less the second's, in the errors' unit.
    """

    p_value: float
    alpha: float
    median_difference: float

    @property
    def significant(self) -> bool:
        """Whether the errors differ at the corrected level."""
        return self.p_value < self.alpha


def compare(
    first: ArrayLike, second: ArrayLike, comparisons: int = 1, alpha: float = 0.05
) -> Comparison:
    """Compare two methods on the same captures.

    Parameters
    ----------
    first, second : array_like of float, shape (N,)
        Absolute errors, paired.
    comparisons : int
        How many comparisons are made in all, for Bonferroni's correction.
    alpha : float
        The level of the whole family.

    Examples
    --------
    >>> result = compare([1.0, 2, 3, 4, 5, 6], [2.0, 3, 4, 5, 6, 7.5], comparisons=4)
    >>> round(result.p_value, 4), result.alpha, result.significant
    (0.0312, 0.0125, False)
    """
    from scipy.stats import wilcoxon

    a, b = np.asarray(first, float), np.asarray(second, float)
    difference = a - b
    if not difference.any():
        return Comparison(1.0, alpha / comparisons, 0.0)
    p_value = float(wilcoxon(a, b).pvalue)
    return Comparison(p_value, alpha / comparisons, float(np.median(difference)))


def bootstrap_mean(
    values: ArrayLike,
    groups: Sequence[Hashable] | None = None,
    level: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> tuple[float, float]:
    """Give the percentile bootstrap interval of a mean.

    Parameters
    ----------
    values : array_like of float, shape (N,)
        One value a capture.
    groups : sequence of hashable, optional
        The fruit of each capture: whole fruit are then drawn with replacement, as captures of
        one fruit are no independent samples.
    level : float
        Level of the interval.
    resamples : int
        Number of resamples.
    seed : int
        Seed of chance.

    Returns
    -------
    low, high : float

    Examples
    --------
    >>> low, high = bootstrap_mean([1.0, 1.0, 9.0, 9.0], groups=["a", "a", "b", "b"])
    >>> low, high
    (1.0, 9.0)
    """
    data = np.asarray(values, float)
    names = list(range(len(data))) if groups is None else list(groups)
    index = {name: k for k, name in enumerate(dict.fromkeys(names))}
    member = np.array([index[name] for name in names])
    total = np.bincount(member, data, len(index))
    size = np.bincount(member, minlength=len(index)).astype(float)
    drawn = np.random.default_rng(seed).integers(len(index), size=(resamples, len(index)))
    means = total[drawn].sum(axis=1) / size[drawn].sum(axis=1)
    tail = 100 * (1 - level) / 2
    low, high = np.percentile(means, [tail, 100 - tail])
    return float(low), float(high)


def binomial_interval(hits: int, count: int, level: float = 0.95) -> tuple[float, float]:
    """Give the exact (Clopper–Pearson) interval of a share.

    Examples
    --------
    >>> low, high = binomial_interval(90, 100)
    >>> round(low, 3), round(high, 3)
    (0.824, 0.951)
    """
    from scipy.stats import binomtest

    found = binomtest(hits, count).proportion_ci(level, method="exact")
    return float(found.low), float(found.high)
