"""Growth of a house, its rows and its fruit, and a Kalman filter for each fruit's lengths.

Growth is linear with day-to-day variability. For fruit i in row r on day t

    x(i, t + 1) = x(i, t) + mu + a(r) + b(i) + w(t) + e(i, t)
    m(i, t) = x(i, t) + measuring error of known variance

with mu the house's growth, a ~ N(0, row²), b ~ N(0, fruit²), w ~ N(0, day²) common to the house,
and e ~ N(0, fruit_day²). Given beta = (mu, a, w), each fruit is a linear Gaussian state (x, b):
a Kalman filter (Kalman 1960) gives its innovations, which are linear in beta, and its state today.

Beta = (house, rows, days) has a normal prior, hence a normal posterior for given spreads (Bayesian
linear regression on the filter's whitened innovations). The five spreads have log-normal priors
about the profile's figures; their posterior is approximated by a normal one of their logarithms at
its mode (Laplace). Without links, both are the prior. The likelihood of the links decides whether
growth slows with length: see `curve`.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from cucumbervision.errors import ForecastError
from cucumbervision.threads import OneThread

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from cucumbervision.agronomy.profiles import CropProfile


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
    index_of_row = {name: k for k, name in enumerate(basis.rows)}
    series = [sorted(set(p)) for p in points]
    counts = np.array([len(s) for s in series], np.intp)
    flat = np.array([point for s in series for point in s], np.float64).reshape(-1, 3)
    first = np.cumsum(counts) - counts
    steps = []

    def add(fruit: Array, start: Array, end: Array, length_m: Array, variance_m2: Array) -> None:
        overlap = basis.overlap(start, end)
        steps.append(
            _Step(
                fruit=fruit,
                elapsed=end - start,
                overlap=overlap,
                length_m=length_m,
                variance_m2=variance_m2,
            )
        )

    for k in range(int(counts.max(initial=0))):
        fruit = np.flatnonzero(counts > k)
        index = first[fruit] + k
        before = flat[index - 1 if k else index, 0]
        add(fruit, before, *flat[index].T)
    if until is not None:
        last = flat[first + counts - 1, 0]
        late = np.flatnonzero(last < until)
        none, end = np.full(len(late), np.nan), np.full(len(late), until)
        add(late, last[late], end, none, none)
    return Histories(basis, np.array([index_of_row[r] for r in rows], np.intp), tuple(steps))


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
            residual = -x
            residual[:, 0] += step.length_m
            scale = p[:, 0] + step.variance_m2
            gain_x, gain_b = p[:, 0] / scale, p[:, 1] / scale
            x += gain_x[:, None] * residual
            b = b + gain_b[:, None] * residual
            p = p - scale[:, None] * np.stack([gain_x**2, gain_x * gain_b, gain_b**2], axis=1)
            residual[:, 1:] *= -1
            innovations.append(residual / np.sqrt(scale)[:, None])
            log_scale += 0.5 * float(np.log(scale).sum())
        length[step.fruit], growth[step.fruit], cov[step.fruit] = x, b, p
    return FilteredStates(
        length=length,
        growth=growth,
        covariance=cov,
        innovations=np.concatenate(innovations),
        log_scale=log_scale,
    )


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


_NEARLY_FULL = 0.98  # beyond this share of the full length, age cannot be inferred from length


@dataclass(frozen=True)
class Curve:
    """Growth that falls linearly with length, from half of `full_m` to zero at `full_m`.

    With dL/dt = rate s(L) and s = min(1, 2 (1 - L / full)), the *unslowed* length u, for which
    du = dL / s(L), grows linearly whatever the length. The whole model is in u: lengths and class
    limits are transformed.

    Parameters
    ----------
    full_m : float
        Full length, metres; infinite for growth that does not slow.

    Examples
    --------
    >>> curve = Curve(0.40)
    >>> curve.rate_share([0.10, 0.20, 0.30]).round(6).tolist()
    [1.0, 1.0, 0.5]
    >>> curve.unslowed([0.10, 0.20, 0.30]).round(4).tolist()  # 0.2 + 0.2 log 2
    [0.1, 0.2, 0.3386]
    """

    full_m: float = float("inf")

    def rate_share(self, length_m: ArrayLike) -> NDArray[np.float64]:
        """Return s(L), the share of the full rate at this length, float64."""
        length = np.asarray(length_m, np.float64)
        if np.isinf(self.full_m):
            return np.ones_like(length)
        share = np.minimum(length / self.full_m, _NEARLY_FULL)
        return np.asarray(np.minimum(2 * (1 - share), 1.0), np.float64)

    def unslowed(self, length_m: ArrayLike) -> NDArray[np.float64]:
        """Return u(L) in metres, float64."""
        length = np.asarray(length_m, np.float64)
        if np.isinf(self.full_m):
            return length
        half = self.full_m / 2
        # Below half of the full length `rate_share` is 1 and its logarithm 0.
        return np.asarray(np.minimum(length, half) - half * np.log(self.rate_share(length)))

    def points(
        self, measured: Sequence[tuple[float, float, float]], pace_m: float
    ) -> list[tuple[float, float, float]]:
        """Transform one fruit's measurements into points of the linear model.

        Parameters
        ----------
        measured : sequence of (day, length_m, sd_m)
            In order of days.
        pace_m : float
            Approximate unslowed growth, metres a day.

        Returns
        -------
        list of (day, unslowed length in m, its variance)
            An error of the length is 1 / s times as large in u, with s at the length predicted from
            the previous point; at the measured length, long readings would weigh less than short
            ones.
        """
        if np.isinf(self.full_m):
            return [(day, length, sd**2) for day, length, sd in measured]
        points: list[tuple[float, float, float]] = []
        for day, length, sd in measured:
            u = float(self.unslowed(length))
            expected = u if not points else points[-1][1] + (day - points[-1][0]) * pace_m
            points.append((day, u, (sd / self._rate_share_of_unslowed(expected)) ** 2))
        return points

    def _rate_share_of_unslowed(self, u_m: float) -> float:
        half = self.full_m / 2
        if u_m <= half:
            return 1.0
        return max(float(np.exp(1 - u_m / half)), 2 * (1 - _NEARLY_FULL))


LINEAR = Curve()

# Assumed error factors of the profile's spreads, up or down: 1.6 for houses, 1.4 for all others.
SPREAD_LOG_SD = np.array([0.5, 0.35, 0.35, 0.35, 0.35])

# Candidate full lengths, as multiples of the longest class's upper limit.
_FULL_LENGTHS = 1.15, 1.3, 1.5, 1.8

# Log likelihood that a curve must gain over the first. Picking alone makes growth look as if it
# slowed, since of the long fruit those that grow slowly stay: 5 to 10 with 500 links.
_PLAINLY_BETTER = 15.0

HYPER_DRAWS = 40

_STEP = 0.05  # of the numerical second derivatives


@dataclass(frozen=True)
class Link:
    """The same fruit measured twice.

    Parameters
    ----------
    fruit_id : str
        Fruit identifier; its links (day 1 to 2, 2 to 3, or 1 to 3) form one history.
    row : str
        Its row.
    day0, day1 : float
        Days of the two measurements, the later one second.
    length0_m, length1_m : float
        The lengths, metres.
    sd0_m, sd1_m : float
        Their standard deviations, metres.

    Raises
    ------
    ForecastError
        If a figure is invalid, or the days are not in order.
    """

    fruit_id: str
    row: str
    day0: float
    length0_m: float
    sd0_m: float
    day1: float
    length1_m: float
    sd1_m: float

    def __post_init__(self) -> None:
        figures = (self.day0, self.day1, self.length0_m, self.length1_m, self.sd0_m, self.sd1_m)
        sizes = figures[2:]
        if not np.isfinite(figures).all() or min(sizes) <= 0 or self.day1 <= self.day0:
            raise ForecastError(
                f"link of fruit {self.fruit_id!r}: day {self.day0} to {self.day1}, lengths "
                f"{self.length0_m} and {self.length1_m} m, sd {self.sd0_m} and {self.sd1_m} m",
                remedy="give finite days, the earlier first, and positive metres",
            )


@dataclass(frozen=True)
class GrowthPrior:
    """Prior of growth.

    Parameters
    ----------
    mean_m : float
        Mean growth, metres a day.
    spreads : Spreads
        Standard deviations of houses, rows, fruit and days.
    curves : tuple of Curve
        Candidate dependences of growth on length; the first is used unless the links clearly favour
        another.
    """

    mean_m: float
    spreads: Spreads
    curves: tuple[Curve, ...] = (LINEAR,)

    @classmethod
    def of(cls, profile: CropProfile) -> GrowthPrior:
        """Take a crop profile's figures.

        Examples
        --------
        >>> from cucumbervision.agronomy.profiles import load_profile
        >>> GrowthPrior.of(load_profile("long-cucumber")).mean_m
        0.03
        """
        g = profile.growth
        cm = (g.house_sd, g.row_sd, g.fruit_sd, g.day_sd, g.fruit_day_sd)
        spreads = Spreads(*(figure / 100 for figure in cm))
        if g.full_cm is not None:
            return cls(g.mean / 100, spreads, (Curve(g.full_cm / 100),))
        curves = [Curve(float(times * profile.edges_m[-1])) for times in _FULL_LENGTHS]
        return cls(g.mean / 100, spreads, (LINEAR, *curves))


@dataclass(frozen=True, eq=False)
class Growth:
    """The posterior of growth.

    Parameters
    ----------
    prior : GrowthPrior
        The prior.
    basis : Basis
        Of the coefficients.
    links : tuple of Link
        The links.
    curve : Curve
        Dependence of growth on length; rates are unslowed.
    pace_m : float
        Median unslowed growth of the links, metres a day, an approximation for `curve`.
    spreads : tuple of Spreads, length H
        Draws from the spreads' posterior.
    mean : ndarray of float64, shape (H, p)
        Posterior mean of the coefficients for each draw, metres a day.
    root : ndarray of float64, shape (H, p, p)
        A square root of their covariance.
    """

    prior: GrowthPrior
    basis: Basis
    links: tuple[Link, ...]
    curve: Curve
    pace_m: float
    spreads: tuple[Spreads, ...]
    mean: NDArray[np.float64]
    root: NDArray[np.float64]


@OneThread()
def fit_growth(links: Sequence[Link], prior: GrowthPrior, seed: int = 0) -> Growth:
    """Learn growth from links.

    Parameters
    ----------
    links : sequence of Link
        May be empty: then the result is the prior.
    prior : GrowthPrior
        The prior.
    seed : int
        Of the draws from the spreads' posterior.

    Returns
    -------
    Growth

    Notes
    -----
    The errors of two measurements are taken as independent. An error common to all lengths, such as
    the camera's depth scale, changes growth by the same share.

    Examples
    --------
    >>> prior = GrowthPrior(0.03, Spreads(0.006, 0.002, 0.005, 0.003, 0.003))
    >>> links = [Link(str(k), "1", 0, 0.2, 0.003, 3, 0.32, 0.003) for k in range(200)]
    >>> growth = fit_growth(links, prior)
    >>> round(100 * float(growth.mean[:, 0].mean()), 1)  # of the house: 4.0 cm a day were seen
    3.8
    """
    rows = tuple(sorted({link.row for link in links}))
    first = int(np.floor(min((link.day0 for link in links), default=0.0)))
    last = int(np.ceil(max((link.day1 for link in links), default=0.0)))
    basis = Basis(rows, first, last - first)
    fruit: dict[str, list[Link]] = {}
    for link in links:
        fruit.setdefault(link.fruit_id, []).append(link)
    rows_of = [links[0].row for links in fruit.values()]
    series = [measured_points(links) for links in fruit.values()]
    problems = [_Problem.of(curve, series, rows_of, basis, prior) for curve in prior.curves]
    best = problems[0]
    mode, root = best.fit()
    # A better curve is better with the first one's spreads too.
    scores = [problem.log_posterior(mode) for problem in problems]
    if max(scores) > scores[0] + _PLAINLY_BETTER:
        best = problems[int(np.argmax(scores))]
        mode, root = best.fit()
    logs = mode + np.random.default_rng(seed).standard_normal((HYPER_DRAWS, 5)) @ root.T
    figures = np.array(astuple(prior.spreads)) * np.exp(logs)
    draws = tuple(Spreads(*line) for line in figures.tolist())
    posteriors = [_coefficients(best.histories, prior, spreads) for spreads in draws]
    means, roots = np.array([f[0] for f in posteriors]), np.array([f[1] for f in posteriors])
    return Growth(
        prior=prior,
        basis=basis,
        links=tuple(links),
        curve=best.curve,
        pace_m=best.pace_m,
        spreads=draws,
        mean=means,
        root=roots,
    )


def measured_points(links: Sequence[Link]) -> list[tuple[float, float, float]]:
    """Return the measurements (day, length_m, sd_m) of one fruit's links, each once, in order."""
    starts = {(k.day0, k.length0_m, k.sd0_m) for k in links}
    return sorted(starts | {(k.day1, k.length1_m, k.sd1_m) for k in links})


@dataclass(frozen=True, eq=False)
class _Problem:
    """The links under one curve, as a function of log(spread / prior's)."""

    prior: GrowthPrior
    curve: Curve
    pace_m: float
    histories: Histories
    log_slope: float

    @classmethod
    def of(
        cls,
        curve: Curve,
        series: Sequence[Sequence[tuple[float, float, float]]],
        rows: Sequence[str],
        basis: Basis,
        prior: GrowthPrior,
    ) -> _Problem:
        steps = [pair for measured in series for pair in pairwise(measured)]
        ends = curve.unslowed([[a[1], b[1]] for a, b in steps]).reshape(-1, 2)
        paces = (ends[:, 1] - ends[:, 0]) / np.array([b[0] - a[0] for a, b in steps])
        pace_m = float(np.median(paces)) if steps else prior.mean_m
        histories = measured_histories([curve.points(m, pace_m) for m in series], rows, basis)
        slope = float(np.log(curve.rate_share([b[1] for _, b in steps])).sum())
        return cls(prior=prior, curve=curve, pace_m=pace_m, histories=histories, log_slope=slope)

    def log_posterior(self, logs: NDArray[np.float64]) -> float:
        centre = np.array(astuple(self.prior.spreads))
        spreads = Spreads(*(centre * np.exp(logs)).tolist())
        prior_term = 0.5 * float(((logs / SPREAD_LOG_SD) ** 2).sum())
        log_likelihood = _coefficients(self.histories, self.prior, spreads)[2]
        # The likelihood of lengths, not of unslowed lengths, includes the derivative between them.
        return log_likelihood - self.log_slope - prior_term

    def fit(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the mode, and a root of the covariance, of the spreads' logarithms."""
        if not len(self.histories.row):
            return np.zeros(5), np.diag(SPREAD_LOG_SD)
        return _laplace(lambda logs: -self.log_posterior(logs))


def _coefficients(
    histories: Histories, prior: GrowthPrior, spreads: Spreads
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return posterior mean and root of beta, and the log marginal likelihood."""
    filtered = kalman_filter(histories, spreads)
    sd = _prior_sd(histories.basis, spreads)
    prior_mean = np.zeros(len(sd))
    prior_mean[0] = prior.mean_m
    design = filtered.innovations[:, 1:] * sd
    residual = filtered.innovations[:, 0] - filtered.innovations[:, 1:] @ prior_mean
    # beta = known + sd u with u ~ N(0, 1): the posterior precision of u is 1 + design' design.
    lower = np.linalg.cholesky(np.eye(len(sd)) + design.T @ design)
    toward = np.linalg.solve(lower, design.T @ residual)
    inverse = np.linalg.inv(lower)
    log_likelihood = -(
        filtered.log_scale
        + float(np.log(np.diag(lower)).sum())
        + 0.5 * float(residual @ residual - toward @ toward)
    )
    return prior_mean + sd * (inverse.T @ toward), sd[:, None] * inverse.T, log_likelihood


def _prior_sd(basis: Basis, spreads: Spreads) -> NDArray[np.float64]:
    """Return the prior standard deviation of each coefficient, metres a day, shape (p,)."""
    rows, days = [spreads.row] * len(basis.rows), [spreads.day] * basis.days
    return np.array([spreads.house, *rows, *days])


def _laplace(
    badness: Callable[[NDArray[np.float64]], float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mode, and a square root of the inverse curvature there."""
    from scipy.optimize import minimize

    size = 5
    optimum = minimize(badness, np.zeros(size), method="L-BFGS-B", bounds=[(-3.0, 3.0)] * size)
    mode = np.asarray(optimum.x, np.float64)
    step = _STEP * np.eye(size)
    curvature = np.empty((size, size))
    for i in range(size):
        for j in range(i, size):
            corners = [
                badness(mode + si * step[i] + sj * step[j]) * si * sj
                for si in (1, -1)
                for sj in (1, -1)
            ]
            curvature[i, j] = curvature[j, i] = sum(corners) / (4 * _STEP**2)
    values, vectors = np.linalg.eigh(curvature)
    # The posterior of the spreads is never wider than the prior.
    values = np.maximum(values, SPREAD_LOG_SD.max() ** -2)
    return mode, vectors / np.sqrt(values)
