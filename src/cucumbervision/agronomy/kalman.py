"""A Kalman filter for the measured lengths of each fruit.

Growth is linear with day-to-day variability. For fruit i in row r on day t

    x(i, t + 1) = x(i, t) + mu + a(r) + b(i) + w(t) + e(i, t)
    m(i, t) = x(i, t) + measuring error of known variance

with mu the house's growth, a ~ N(0, row²), b ~ N(0, fruit²), w ~ N(0, day²) common to the house,
and e ~ N(0, fruit_day²). Given beta = (mu, a, w), each fruit is a linear Gaussian state (x, b):
a Kalman filter (Kalman 1960) gives its innovations, which are linear in beta, and its state today.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

Array: TypeAlias = "NDArray[Any]"
Point = tuple[float, float, float]  # day, length in metres, its variance


@dataclass(frozen=True)
class Spreads:
    """Standard deviations of growth, metres a day: house, rows, fruit, days, fruit's days."""

    house: float
    row: float
    fruit: float
    day: float
    fruit_day: float


@dataclass(frozen=True)
class Basis:
    """The coefficients of beta: the house, its rows, and the days that the links span."""

    rows: tuple[str, ...]
    first_day: int
    days: int

    @property
    def size(self) -> int:
        """Number of coefficients: 1 + rows + days."""
        return 1 + len(self.rows) + self.days

    def overlap(self, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of each day between `start` and `end`, shape (N, days)."""
        days = self.first_day + np.arange(self.days)
        upper = np.minimum(end[:, None], days + 1)
        return np.asarray(np.maximum(upper - np.maximum(start[:, None], days), 0.0))


@dataclass(frozen=True, eq=False)
class _Step:
    """The k-th point of each fruit.

    `length_m` and `variance_m2` are NaN for a prediction without a measurement.
    """

    fruit: NDArray[np.intp]
    elapsed: NDArray[np.float64]
    overlap: NDArray[np.float64]
    length_m: NDArray[np.float64]
    variance_m2: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Histories:
    """Measured lengths of N fruit: the basis, the index of each fruit's row, the steps."""

    basis: Basis
    row: NDArray[np.intp]
    steps: tuple[_Step, ...]


@dataclass(frozen=True, eq=False)
class FilteredStates:
    """The filter's result.

    Parameters
    ----------
    length, growth : ndarray of float64, shape (N, 1 + p)
        Means of x and b: the first column plus the others times beta; metres, metres a day.
    covariance : ndarray of float64, shape (N, 3)
        Variance of x, covariance, variance of b.
    innovations : ndarray of float64, shape (M, 1 + p)
        Whitened: the first column less the others times beta is standard normal.
    log_scale : float
        Sum of the logarithms of the innovations' standard deviations.
    """

    length: NDArray[np.float64]
    growth: NDArray[np.float64]
    covariance: NDArray[np.float64]
    innovations: NDArray[np.float64]
    log_scale: float


def measured_histories(
    points: Sequence[Sequence[Point]], rows: Sequence[str], basis: Basis, until: float | None = None
) -> Histories:
    """Sort the points of each fruit and arrange them step by step.

    Parameters
    ----------
    points : sequence of sequences of (day, length_m, variance_m2)
        Of each fruit, at least one; the same point twice counts once.
    rows : sequence of str
        The row of each fruit, of the basis.
    basis : Basis
        Of the coefficients.
    until : float, optional
        A day to which every fruit is extrapolated from its last point.
    """
    known = {name: k for k, name in enumerate(basis.rows)}
    series = [sorted(set(p)) for p in points]
    counts = np.array([len(s) for s in series], np.intp)
    flat = np.array([point for s in series for point in s], np.float64).reshape(-1, 3)
    first = np.cumsum(counts) - counts
    steps = []

    def add(fruit: Array, start: Array, end: Array, length_m: Array, variance_m2: Array) -> None:
        overlap = basis.overlap(start, end)
        steps.append(_Step(fruit, end - start, overlap, length_m, variance_m2))

    for k in range(int(counts.max(initial=0))):
        fruit = np.flatnonzero(counts > k)
        at = first[fruit] + k
        before = flat[at - 1 if k else at, 0]
        add(fruit, before, *flat[at].T)
    if until is not None:
        last = flat[first + counts - 1, 0]
        late = np.flatnonzero(last < until)
        none, end = np.full(len(late), np.nan), np.full(len(late), until)
        add(late, last[late], end, none, none)
    return Histories(basis, np.array([known[r] for r in rows], np.intp), tuple(steps))


def kalman_filter(histories: Histories, spreads: Spreads) -> FilteredStates:
    """Run a Kalman filter along the points of every fruit, all fruit at once.

    The prior of the length is flat, so the first point starts the state and has no information on
    growth.

    Examples
    --------
    Two lengths 3 cm apart in a day, both exact, growth known to vary among fruit alone:

    >>> basis = Basis(("1",), 0, 0)
    >>> seen = measured_histories([[(0.0, 0.20, 0.0), (1.0, 0.23, 0.0)]], ["1"], basis)
    >>> spreads = Spreads(0.006, 0.002, 0.005, 1e-9, 1e-9)
    >>> found = kalman_filter(seen, spreads)
    >>> found.length[:, 0].round(4), found.growth.round(4)  # b = 0.03 - mu - a
    (array([0.23]), array([[ 0.03, -1.  , -1.  ]]))
    """
    count, width = len(histories.row), 1 + histories.basis.size
    length, growth = np.zeros((count, width)), np.zeros((count, width))
    cov = np.zeros((count, 3))
    cov[:, 2] = spreads.fruit**2
    innovations, log_scale = [np.empty((0, width))], 0.0
    for k, step in enumerate(histories.steps):
        if k == 0:
            length[step.fruit, 0] = step.length_m
            cov[step.fruit, 0] = step.variance_m2
            continue
        x, b = _carried(histories, step, length, growth)
        p = _carried_cov(step, cov[step.fruit], spreads)
        if not np.isnan(step.length_m).any():
            rest = -x
            rest[:, 0] += step.length_m
            scale = p[:, 0] + step.variance_m2
            gain_x, gain_b = p[:, 0] / scale, p[:, 1] / scale
            x += gain_x[:, None] * rest
            b = b + gain_b[:, None] * rest
            p = p - scale[:, None] * np.stack([gain_x**2, gain_x * gain_b, gain_b**2], axis=1)
            rest[:, 1:] *= -1
            innovations.append(rest / np.sqrt(scale)[:, None])
            log_scale += 0.5 * float(np.log(scale).sum())
        length[step.fruit], growth[step.fruit], cov[step.fruit] = x, b, p
    return FilteredStates(length, growth, cov, np.concatenate(innovations), log_scale)


def _carried(
    histories: Histories, step: _Step, length: NDArray[np.float64], growth: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    b = growth[step.fruit]
    x = length[step.fruit] + step.elapsed[:, None] * b
    x[:, 1] += step.elapsed
    x[np.arange(len(x)), 2 + histories.row[step.fruit]] += step.elapsed
    x[:, 2 + len(histories.basis.rows) :] += step.overlap
    return x, b


def _carried_cov(step: _Step, cov: NDArray[np.float64], spreads: Spreads) -> NDArray[np.float64]:
    elapsed = step.elapsed
    # Days outside the basis have no coefficient and count as variance of each fruit.
    outside = elapsed - step.overlap.sum(axis=1)
    noise = elapsed * spreads.fruit_day**2 + outside * spreads.day**2
    x = cov[:, 0] + 2 * elapsed * cov[:, 1] + elapsed**2 * cov[:, 2] + noise
    return np.stack([x, cov[:, 1] + elapsed * cov[:, 2], cov[:, 2]], axis=1)
