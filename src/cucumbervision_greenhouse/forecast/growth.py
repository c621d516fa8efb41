"""Growth of a house and its fruit along one curve, and draws of their lengths on the coming days.

A fruit grows at its full rate up to half of the length at which growth stops, and then ever more
slowly. Along the curve, the length that it would have without slowing, its *stage*, grows linearly,
in metres a day, by

    house + fruit,    fruit ~ N(0, row² + fruit²)

The weighted line through a fruit's stages measures its growth, with an error from the lengths'
errors and the day-to-day growth. The posterior mean of the house is that of what was measured and
of the profile, weighted by inverse variances (Gelman and Hill 2007, chapter 12). The variance
between fruit is estimated from their scatter by moments (DerSimonian and Laird 1986) and pooled
with the profile's. The length at which growth stops is one of several, weighted by how well each
explains the fruit that were measured on several days. Without these everything is the profile's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from cucumbervision.arrays import Array, Array32, Numbers
from cucumbervision.crop.profiles import CropProfile

Point: TypeAlias = "tuple[float, float, float]"  # day, length in metres, its standard deviation


@dataclass(frozen=True)
class Spreads:
    """Standard deviations of growth, metres a day: house, rows, fruit, days, fruit's days."""

    house: float
    row: float
    fruit: float
    day: float
    fruit_day: float


# The profile's variance between fruit counts as much as the scatter of so many fruit: an assumed
# error of a factor of 1.4 in the standard deviation.
_PRIOR_FRUIT = 4.0
_LEAST_VARIANCE = 0.1  # least variance between fruit, as a share of the profile's
_FASTEST_SD = 3.0  # fruit that grow faster than the median by more are too few to matter
_LEAST_FAIR = 1 / 3  # of the fruit; with fewer the loss of links would outweigh the bias
_LEAST_SHARE = 0.1  # of the full growth, that is left to longer fruit: lengths have errors
_CURVES = 6  # lengths at which growth may stop, beside infinity
_NEAREST = 1.05  # the shortest of them, as a multiple of the longest length that is sold
# Fruit of a row and a day are alike: so many count at most as evidence for a curve.
_INDEPENDENT = 40
_SLOWING = 0.75, 0.25  # prior probabilities that growth slows: for ranges, for what is expected
_LEAST_WEIGHT = 0.02  # of a curve that is drawn from
_EXACT_M = 1e-6  # standard deviation of a length that is known


def rate_share(length_m: ArrayLike, full_m: float) -> Array:
    """Return the share of its full growth by which a fruit of this length grows, float64.

    It falls linearly from 1 at half of `full_m`, the length at which growth stops, to 0.

    Examples
    --------
    >>> rate_share([0.10, 0.20, 0.30, 0.50], full_m=0.40).round(6).tolist()
    [1.0, 1.0, 0.5, 0.0]
    """
    return np.clip(2 * (1 - np.asarray(length_m, np.float64) / full_m), 0.0, 1.0)


def stage_of(length_m: Numbers, full_m: float) -> Numbers:
    """Return the length that a fruit would have if its growth did not slow, metres.

    A tenth of the growth is left to the longest, so that each length has a stage.

    Examples
    --------
    >>> stage_of(np.array([0.10, 0.20, 0.30]), full_m=0.40).round(3).tolist()
    [0.1, 0.2, 0.339]
    """
    if np.isinf(full_m):
        return length_m
    slowing_m = np.minimum(length_m, full_m * (1 - _LEAST_SHARE / 2))
    stage_m = full_m / 2 * (1 - np.log(2 * (1 - slowing_m / full_m)))
    return np.where(
        length_m < full_m / 2, length_m, stage_m + (length_m - slowing_m) / _LEAST_SHARE
    )


def length_of(stage_m: Numbers, full_m: float) -> Numbers:
    """Return the length of a fruit at a stage, metres: the inverse of `stage_of`.

    Examples
    --------
    >>> length_of(stage_of(np.array([0.10, 0.30, 0.50]), 0.40), 0.40).round(3).tolist()
    [0.1, 0.3, 0.5]
    """
    if np.isinf(full_m):
        return stage_m
    slowing_m = np.minimum(stage_m, full_m / 2 * (1 - np.log(_LEAST_SHARE)))
    length_m = full_m * (1 - np.exp(1 - 2 * slowing_m / full_m) / 2)
    return np.where(stage_m < full_m / 2, stage_m, length_m + (stage_m - slowing_m) * _LEAST_SHARE)


@dataclass(frozen=True)
class FruitState:
    """The last measurement of one fruit, and the earlier ones.

    Parameters
    ----------
    fruit_id : str
        Fruit identifier.
    row : str
        Its row.
    position_m : float
        Along the row, metres.
    length_m, sd_m : float
        The length that the profile grades by, and its standard deviation, metres.
    day : float
        Day of the measurement.
    side : str
        Side of the row.
    best_class : str
        The best class that its shape allows, as `Grade.best_class` gives it; empty for any.
    picked : bool
        Whether it has been picked: no count includes it.
    possible : tuple of str
        The classes that it may be in on its day, as `Grade.possible` gives them; by default those
        that its 90 % interval spans.
    at_least : bool
        Whether only a lower bound was measured, or nothing: `length_m` and `sd_m` are then those of
        similar fruit.
    earlier : tuple of (day, length_m, sd_m)
        Earlier measurements of the same fruit, in order.
    """

    fruit_id: str
    row: str
    position_m: float
    length_m: float
    sd_m: float
    day: float = 0.0
    side: str = ""
    best_class: str = ""
    picked: bool = False
    possible: tuple[str, ...] = ()
    at_least: bool = False
    earlier: tuple[Point, ...] = ()

    @property
    def points(self) -> tuple[Point, ...]:
        """All measurements, the last one included."""
        return (*self.earlier, (self.day, self.length_m, self.sd_m))


@dataclass(frozen=True)
class GrowthPrior:
    """Prior of growth.

    Parameters
    ----------
    mean_m : float
        Mean growth, metres a day.
    spreads : Spreads
        Standard deviations of houses, rows, fruit and days.
    full_m : tuple of float
        The lengths at which growth may stop; infinite for growth that does not slow.
    shortest_m : float
        The shortest length that is measured, metres.
    source : str
        Source of the figures.
    """

    mean_m: float
    spreads: Spreads
    full_m: tuple[float, ...] = (float("inf"),)
    shortest_m: float = 0.0
    source: str = ""

    @classmethod
    def of(cls, profile: CropProfile) -> GrowthPrior:
        """Take a crop profile's figures.

        Examples
        --------
        >>> from cucumbervision.crop.profiles import load_profile
        >>> GrowthPrior.of(load_profile("long-cucumber")).mean_m
        0.03
        """
        g = profile.growth
        cm = (g.house_sd, g.row_sd, g.fruit_sd, g.day_sd, g.fruit_day_sd)
        spreads = Spreads(*(figure / 100 for figure in cm))
        nearest_m = _NEAREST * float(profile.edges_m[-1])
        full_m = (float("inf"), *(nearest_m * _CURVES / k for k in range(1, _CURVES + 1)))
        if g.full_cm is not None:
            full_m = (g.full_cm / 100,)
        return cls(g.mean / 100, spreads, full_m, profile.accepted_m[0], g.source)


def line_sums(histories: Sequence[Sequence[Point]], spreads: Spreads, full_m: float) -> Array:
    """Return sums over the points of N fruit: what a line through each needs, float64.

    Days count from a fruit's last point, so that they are 0 or negative. A point's weight is the
    inverse of the variance of its stage and of the day-to-day growth since then.

    Parameters
    ----------
    histories : sequence of sequence of (day, length_m, sd_m)
        The points of each fruit in order of days, at least one.
    spreads : Spreads
        Those of days are used.
    full_m : float
        Length at which growth stops, metres.

    Returns
    -------
    ndarray of float64, shape (5, N)
        Weighted sums of 1, day, day², stage, and day times stage.
    """
    counts = [len(points) for points in histories]
    fruit = np.repeat(np.arange(len(counts)), counts)
    flat = np.array([p for points in histories for p in points], np.float64).reshape(-1, 3)
    day, length_m, sd_m = flat.T
    day = day - day[np.cumsum(counts, dtype=np.intp) - 1][fruit]
    sd_m = sd_m / np.maximum(rate_share(length_m, full_m), _LEAST_SHARE)
    stage_m = stage_of(length_m, full_m)
    weight = 1 / (sd_m**2 - (spreads.day**2 + spreads.fruit_day**2) * day)
    terms = (np.ones_like(day), day, day**2, stage_m, day * stage_m)
    sums = [np.bincount(fruit, weight * term, len(counts)) for term in terms]
    return np.array(sums, np.float64)  # without fruit they would be whole numbers


def _slopes(sums: Array) -> tuple[Array, Array]:
    """Return the growth of fruit with two points or more, and its variance, from `line_sums`."""
    weight, day, day_day, stage, day_stage = sums
    spread = weight * day_day - day**2
    return (weight * day_stage - day * stage) / spread, weight / spread


@dataclass(frozen=True)
class Curve:
    """Growth if it stops at a certain length.

    Parameters
    ----------
    full_m : float
        That length, metres.
    mean_m, sd_m : float
        Full growth of the house, metres a day, and its standard deviation.
    fruit_sd_m : float
        Standard deviation between fruit.
    weight, share : float
        Probability of this curve for the ranges, where growth may well slow; and for what is
        expected, where it does not until the fruit show it.
    """

    full_m: float
    mean_m: float
    sd_m: float
    fruit_sd_m: float
    weight: float = 1.0
    share: float = 1.0


@dataclass(frozen=True, eq=False)
class Growth:
    """The posterior of growth: its prior, the curves that explain the fruit, and their number."""

    prior: GrowthPrior
    curves: tuple[Curve, ...]
    fruit: int = 0

    @property
    def mean_m(self) -> float:
        """Mean growth of the house until it slows, metres a day."""
        return sum(curve.share * curve.mean_m for curve in self.curves)

    @property
    def mean_sd_m(self) -> float:
        """Standard deviation of `mean_m`."""
        squares = sum(c.share * (c.mean_m**2 + c.sd_m**2) for c in self.curves)
        return float(np.sqrt(max(squares - self.mean_m**2, 0.0)))


def fit_growth(fruit: Sequence[FruitState], prior: GrowthPrior) -> Growth:
    """Learn growth from the fruit that were measured on several days.

    Parameters
    ----------
    fruit : sequence of FruitState
        Those without earlier measurements are ignored; without any others the result is the prior.
    prior : GrowthPrior
        The prior.

    Notes
    -----
    The errors of two measurements are taken as independent. An error common to all lengths, such as
    the camera's depth scale, changes growth by the same share.

    A fruit that is short and grew fast was too short to be measured earlier, so that short fruit
    that were measured before favour slow growth. Only fruit that would have been long enough at any
    likely growth count for the house, where they are a third of all.

    Examples
    --------
    >>> prior = GrowthPrior(0.03, Spreads(0.006, 0.002, 0.005, 0.003, 0.003))
    >>> before = ((0, 0.2, 0.003),)
    >>> fruit = [FruitState(str(k), "1", 0, 0.32, 0.003, 3, earlier=before) for k in range(200)]
    >>> round(100 * fit_growth(fruit, prior).mean_m, 1)  # 4.0 cm a day were seen
    3.9
    """
    # Of the first and the last length: each length between would be evidence of its own.
    histories = [(state.points[0], state.points[-1]) for state in fruit if state.earlier]
    fair = _fair(histories, prior)
    fits = [_fit(fair, prior, full_m) for full_m in prior.full_m]
    evidence = np.array([log_evidence for _, log_evidence in fits])
    weight = np.exp(evidence - evidence.max())
    weight[weight < _LEAST_WEIGHT * weight.sum()] = 0
    is_slowing = np.isfinite(prior.full_m)
    weight, share = (
        weight * np.where(is_slowing, slowing / _CURVES, 1 - slowing) for slowing in _SLOWING
    )
    weight, share = weight / weight.sum(), share / share.sum()
    curves = [
        replace(curve, weight=float(w), share=float(s))
        for (curve, _), w, s in zip(fits, weight, share, strict=True)
        if w
    ]
    return Growth(prior, tuple(curves), len(histories))


def _fit(
    histories: Sequence[Sequence[Point]], prior: GrowthPrior, full_m: float
) -> tuple[Curve, float]:
    """Return a curve fitted to the points of fruit, and the logarithm of its evidence."""
    spreads = prior.spreads
    prior_fruit_var = spreads.row**2 + spreads.fruit**2
    if not histories:
        return Curve(full_m, prior.mean_m, spreads.house, prior_fruit_var**0.5), 0.0
    growth, error = _slopes(line_sums(histories, spreads, full_m))
    fruit_var = _fruit_variance(growth, error, prior_fruit_var)
    weight = 1 / (fruit_var + error)
    measured_m = np.average(growth, weights=weight)
    # What the fruit have in common, the weather of these days, does not average out over fruit.
    days = max(p[-1][0] for p in histories) - min(p[0][0] for p in histories)
    measured_var = 1 / weight.sum() + spreads.day**2 / days
    house_var = spreads.house**2
    share = house_var / (house_var + measured_var)
    # Of the first lengths given the last, which alone decide who has a link: hence the share.
    first_m = np.array([points[0][1] for points in histories])
    density = np.log(weight) / 2 - weight * (growth - measured_m) ** 2 / 2
    density -= np.log(np.maximum(rate_share(first_m, full_m), _LEAST_SHARE))
    surprise = (measured_m - prior.mean_m) ** 2 / (house_var + measured_var)
    surprise += np.log((house_var + measured_var) * weight.sum())
    mean_m = float(prior.mean_m + share * (measured_m - prior.mean_m))
    curve = Curve(full_m, mean_m, float(np.sqrt(share * measured_var)), fruit_var**0.5)
    independent = 1 / (1 + len(growth) / _INDEPENDENT)
    return curve, float(density.sum() * independent - surprise / 2)


def _fair(histories: list[tuple[Point, Point]], prior: GrowthPrior) -> list[tuple[Point, Point]]:
    """Return the fruit that would have been long enough for their first round at likely growth."""
    if not histories:
        return []
    growth, _ = _slopes(line_sums(histories, prior.spreads, np.inf))
    likely_m = float(np.median(growth)) + _FASTEST_SD * prior.spreads.fruit
    fair = [
        points
        for points in histories
        if points[-1][1] - likely_m * (points[-1][0] - points[0][0]) > prior.shortest_m
    ]
    return fair if len(fair) >= _LEAST_FAIR * len(histories) else histories


def _fruit_variance(growth: Array, error: Array, prior: float) -> float:
    """Return the variance of growth between fruit, from their growth and its errors.

    A residual's square has the expectation (variance + error) times its freedom, 1 less the fruit's
    share of the mean: a single fruit tells nothing.
    """
    weight = 1 / (prior + error)
    residual = growth - np.average(growth, weights=weight)
    freedom = 1 - weight / weight.sum()
    information = (prior * weight) ** 2
    scatter = float((information * (residual**2 - freedom * error)).sum())
    variance = (_PRIOR_FRUIT * prior + scatter) / (
        _PRIOR_FRUIT + float((information * freedom).sum())
    )
    return max(variance, _LEAST_VARIANCE * prior)


@dataclass(frozen=True, eq=False)
class FruitLines:
    """The posterior of N fruit's last stage and growth, given the growth g of their house.

    Parameters
    ----------
    day : ndarray of float64, shape (N,)
        Of the last length.
    stage_m, growth_m : ndarray of float64, shape (2, N)
        Means: the first line plus the second times g; metres, metres a day.
    covariance : ndarray of float64, shape (3, N)
        Variance of the stage, covariance, variance of the growth.
    """

    day: Array
    stage_m: Array
    growth_m: Array
    covariance: Array


def fruit_lines(
    fruit: Sequence[FruitState], growth: Growth, curve: Curve, scale_sd: float
) -> FruitLines:
    """Return the line of each fruit through its stages, its slope pooled with the house's growth.

    Parameters
    ----------
    fruit, growth, scale_sd
        As `draw_lengths` takes them.
    curve : Curve
        One of the growth's.
    """
    histories = []
    for state in fruit:
        alone_var = max(state.sd_m**2 - (scale_sd * state.length_m) ** 2, (0.1 * state.sd_m) ** 2)
        histories.append([*state.earlier, (state.day, state.length_m, alone_var**0.5)])
    sums = line_sums(histories, growth.prior.spreads, curve.full_m)
    weight, day, day_day, stage, day_stage = sums
    # The house's growth is one more measurement of the slope.
    pull = curve.fruit_sd_m**-2
    day_day += pull
    determinant = weight * day_day - day**2
    stage_m = day_day * stage - day * day_stage, -pull * day
    growth_m = weight * day_stage - day * stage, pull * weight
    return FruitLines(
        day=np.array([state.day for state in fruit], np.float64),
        stage_m=np.array(stage_m) / determinant,
        growth_m=np.array(growth_m) / determinant,
        covariance=np.array([day_day, -day, weight]) / determinant,
    )


def lengths_today(
    fruit: Sequence[FruitState], growth: Growth, today: float, scale_sd: float
) -> tuple[Array, Array]:
    """Return the mean and standard deviation of each length today, metres, (N,)."""
    spreads = growth.prior.spreads
    mean_m, squares = np.zeros((2, len(fruit)))
    for curve in growth.curves:
        lines = fruit_lines(fruit, growth, curve, scale_sd)
        days = today - lines.day
        by_house = lines.stage_m[1] + days * lines.growth_m[1]
        stage_m = lines.stage_m[0] + days * lines.growth_m[0] + by_house * curve.mean_m
        of_stage, shared, of_growth = lines.covariance
        variance = of_stage + 2 * days * shared + days**2 * of_growth
        variance += days * (spreads.day**2 + spreads.fruit_day**2) + (by_house * curve.sd_m) ** 2
        length_m = length_of(stage_m, curve.full_m)
        variance *= rate_share(length_m, curve.full_m) ** 2
        mean_m += curve.share * length_m
        squares += curve.share * (length_m**2 + variance)
    return mean_m, np.sqrt(np.maximum(squares - mean_m**2, 0.0) + (scale_sd * mean_m) ** 2)


def draw_lengths(
    fruit: Sequence[FruitState],
    growth: Growth,
    today: float,
    days: int,
    draws: int,
    scale_sd: float,
    rng: np.random.Generator,
    shortest_m: float,
) -> tuple[Array32, Array32, Array]:
    """Draw the lengths of fruit on days 0 to `days`; lengths never shrink.

    Parameters
    ----------
    fruit : sequence of FruitState
        N fruit.
    growth : Growth
        The posterior.
    today : float
        Day 0; every fruit is extrapolated to it.
    days, draws : int
        Days ahead, and number of draws.
    scale_sd : float
        Relative standard deviation of an error common to all lengths.
    rng : numpy.random.Generator
        Random generator.
    shortest_m : float
        Length of a newcomer today, metres: the shortest that is measured.

    Returns
    -------
    lengths_m : ndarray of float32, shape (days + 1, draws, N)
        Of the fruit.
    share : ndarray of float64, shape (draws,)
        Of each draw in what is expected; they add to 1.
    newcomer_m : ndarray of float32, shape (days + 1, draws)
        Of a newcomer.
    share : ndarray of float64, shape (draws,)
        Of each draw in what is expected; together 1.
    """
    spreads, drawn = growth.prior.spreads, []
    hanging = [*fruit, FruitState("", "", 0.0, shortest_m, _EXACT_M, today)]
    gap = np.array([today - state.day for state in hanging], np.float32)
    ends = np.round(draws * np.cumsum([0.0, *(c.weight for c in growth.curves)])).astype(int)
    [later] = rng.spawn(1)  # today's draws do not depend on the number of days
    counts = np.diff(ends)
    share = np.repeat([c.share for c in growth.curves] / np.maximum(counts, 1), counts)
    for curve, count in zip(growth.curves, counts.tolist(), strict=True):
        lines = fruit_lines(hanging, growth, curve, scale_sd)
        of_stage, shared, of_growth = lines.covariance
        root = np.array([of_stage, shared, np.zeros_like(shared)]) / np.sqrt(of_stage)
        root[2] = np.sqrt(np.maximum(of_growth - root[1] ** 2, 0.0))
        stage, slope, sd = (
            part.astype(np.float32) for part in (lines.stage_m, lines.growth_m, root)
        )
        house_m = curve.mean_m + curve.sd_m * rng.standard_normal((count, 1), np.float32)
        first, second = rng.standard_normal((2, count, len(hanging)), np.float32)
        stages_m = np.empty((days + 1, count, len(hanging)), np.float32)
        stages_m[0] = stage[0] + stage[1] * house_m + sd[0] * first
        growth_m = slope[0] + slope[1] * house_m + sd[1] * first + sd[2] * second
        if gap.any():
            stages_m[0] += _step(growth_m, gap, spreads, later)
        for day in range(days):
            stages_m[day + 1] = stages_m[day] + _step(growth_m, np.float32(1), spreads, later)
        drawn.append(length_of(stages_m, curve.full_m))
    lengths_m = np.concatenate(drawn, axis=1)
    lengths_m *= np.exp(scale_sd * rng.standard_normal((draws, 1))).astype(np.float32)
    return lengths_m[..., :-1], lengths_m[..., -1], share / share.sum()


def _step(
    growth_m: Array32, days: Array32 | np.float32, spreads: Spreads, rng: np.random.Generator
) -> Array32:
    """Draw how far fruit come in some days, (draws, N): never back."""
    step = rng.standard_normal(growth_m.shape, np.float32)
    step *= np.float32(spreads.fruit_day)
    step += (spreads.day * rng.standard_normal((len(step), 1))).astype(np.float32)
    step *= np.sqrt(days)
    step += days * growth_m
    return np.maximum(step, 0, out=step)
