"""Sums of small regression trees, as the laboratory fits them: what spreads an interval."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Trees:
    """Regression trees of depth two whose values are added (gradient boosting; Friedman 2001).

    Parameters
    ----------
    start : float
        What is added to: the value without any tree.
    features : tuple of (int, int, int)
        For each tree the index of the feature that it asks first, then that of the feature that it
        asks at or below the first limit, and above it.
    limits : tuple of (float, float, float)
        The limits of the three.
    leaves : tuple of (float, float, float, float)
        For each tree its values, from below both limits to above both.

    Examples
    --------
    >>> trees = Trees(-4.0, ((0, 1, 1),), ((0.5, 10.0, 20.0),), ((0.0, 0.1, 0.2, 0.4),))
    >>> [trees.value(np.array(row)) for row in ([0.3, 15.0], [0.7, 15.0], [0.7, 25.0])]
    [-3.9, -3.8, -3.6]
    """

    start: float
    features: tuple[tuple[int, int, int], ...] = ()
    limits: tuple[tuple[float, float, float], ...] = ()
    leaves: tuple[tuple[float, float, float, float], ...] = ()

    def value(self, row: NDArray[np.float64]) -> float:
        """Return the sum for one row of features, float64 of shape (F,)."""
        features, limits, leaves = self._arrays
        if not len(features):
            return self.start
        above = row[features] > limits
        second = np.where(above[:, 0], above[:, 2], above[:, 1])
        return self.start + float(leaves[np.arange(len(leaves)), 2 * above[:, 0] + second].sum())

    @cached_property
    def _arrays(self) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
        return np.array(self.features, np.intp), np.array(self.limits), np.array(self.leaves)
