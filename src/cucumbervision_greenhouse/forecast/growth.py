"""Growth of a house and its fruit along one curve, by weighted means in closed form.

A fruit grows at its full rate up to half of the length at which growth stops, and then ever more
slowly. Along the curve, the length that it would have without slowing, its *stage*, grows linearly,
in metres a day, by

    house + fruit,    fruit ~ N(0, row² + fruit²)

The weighted line through a fruit's stages measures its growth, with an error from the lengths'
errors and the day-to-day growth. The posterior mean of the house is that of what was measured and
of the profile, weighted by inverse variances (Gelman and Hill 2007, chapter 12). The variance
between fruit is estimated from their scatter by moments (DerSimonian and Laird 1986) and pooled
with the profile's. The length at which growth stops is one of several, weighted by how well each
explains the links. Without links everything is the profile's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from cucumbervision.crop.profiles import CropProfile

    Point = tuple[float, float, float]  # day, length in metres, its standard deviation


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
_INDEPENDENT = 100
_LEAST_WEIGHT = 0.02  # of a curve that is drawn from


def rate_share(length_m: ArrayLike, full_m: float) -> NDArray[np.float64]:
    """Return the share of its full growth by which a fruit of this length grows, float64.

    It falls linearly from 1 at half of `full_m`, the length at which growth stops, to 0.

    Examples
    --------
    >>> rate_share([0.10, 0.20, 0.30, 0.50], full_m=0.40).round(6).tolist()
    [1.0, 1.0, 0.5, 0.0]
    """
    return np.clip(2 * (1 - np.asarray(length_m, np.float64) / full_m), 0.0, 1.0)


def stage_of(length_m: NDArray[Any], full_m: float) -> NDArray[Any]:
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


def length_of(stage_m: NDArray[Any], full_m: float) -> NDArray[Any]:
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
    """

    fruit_id: str
    row: str
    day0: float
    length0_m: float
    sd0_m: float
    day1: float
    length1_m: float
    sd1_m: float


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


@dataclass(frozen=True, eq=False)
class LineSums:
    """Sums over the points of N fruit, float64, shape (N,): what a line through each needs.

    Days count from a fruit's last point, so that they are 0 or negative. A point's weight is the
    inverse of the variance of its stage and of the day-to-day growth since then.

    Parameters
    ----------
    weight, day, day_day, stage, day_stage : ndarray
        Weighted sums of 1, day, day², stage, and day times stage.
    """

    weight: NDArray[np.float64]
    day: NDArray[np.float64]
    day_day: NDArray[np.float64]
    stage: NDArray[np.float64]
    day_stage: NDArray[np.float64]

    @classmethod
    def of(cls, histories: Sequence[Sequence[Point]], spreads: Spreads, full_m: float) -> LineSums:
        """Sum the points of each fruit, which are in order of days, at least one."""
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
        return cls(*(np.asarray(total, np.float64) for total in sums))

    def slopes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the growth of fruit with two points or more, and its variance."""
        spread = self.weight * self.day_day - self.day**2
        return (self.weight * self.day_stage - self.day * self.stage) / spread, self.weight / spread


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
    weight : float
        Probability of this curve.
    """

    full_m: float
    mean_m: float
    sd_m: float
    fruit_sd_m: float
    weight: float = 1.0


@dataclass(frozen=True, eq=False)
class Growth:
    """The posterior of growth: prior, links, and the curves that explain them."""

    prior: GrowthPrior
    links: tuple[Link, ...]
    curves: tuple[Curve, ...]

    @property
    def mean_m(self) -> float:
        """Mean growth of the house until it slows, metres a day."""
        return sum(curve.weight * curve.mean_m for curve in self.curves)

    @property
    def mean_sd_m(self) -> float:
        """Standard deviation of `mean_m`."""
        squares = sum(c.weight * (c.mean_m**2 + c.sd_m**2) for c in self.curves)
        return float(np.sqrt(max(squares - self.mean_m**2, 0.0)))


def fit_growth(links: Sequence[Link], prior: GrowthPrior) -> Growth:
    """Learn growth from links.

    Parameters
    ----------
    links : sequence of Link
        May be empty: then the result is the prior.
    prior : GrowthPrior
        The prior.

    Notes
    -----
    The errors of two measurements are taken as independent. An error common to all lengths, such as
    the camera's depth scale, changes growth by the same share.

    A fruit that is short and grew fast was too short to be measured earlier and has no link, so
    that links of short fruit favour slow ones. Only fruit that would have been long enough at any
    likely growth count for the house, where they are a third of all.

    Examples
    --------
    >>> prior = GrowthPrior(0.03, Spreads(0.006, 0.002, 0.005, 0.003, 0.003))
    >>> links = [Link(str(k), "1", 0, 0.2, 0.003, 3, 0.32, 0.003) for k in range(200)]
    >>> round(100 * fit_growth(links, prior).mean_m, 1)  # 4.0 cm a day were seen
    3.9
    """
    histories = [measured_points(group) for group in links_by_fruit(links).values()]
    histories = _fair(histories, prior)
    fits = [_fit(histories, prior, full_m) for full_m in prior.full_m]
    evidence = np.array([log_evidence for _, log_evidence in fits])
    weight = np.exp(evidence - evidence.max())
    weight[weight < _LEAST_WEIGHT * weight.sum()] = 0
    weight /= weight.sum()
    curves = [
        replace(curve, weight=float(w)) for (curve, _), w in zip(fits, weight, strict=True) if w
    ]
    return Growth(prior, tuple(links), tuple(curves))


def _fit(
    histories: Sequence[Sequence[Point]], prior: GrowthPrior, full_m: float
) -> tuple[Curve, float]:
    """Return a curve fitted to the points of fruit, and the logarithm of its evidence."""
    spreads = prior.spreads
    prior_fruit_var = spreads.row**2 + spreads.fruit**2
    if not histories:
        return Curve(full_m, prior.mean_m, spreads.house, prior_fruit_var**0.5), 0.0
    growth, error = LineSums.of(histories, spreads, full_m).slopes()
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


def links_by_fruit(links: Sequence[Link]) -> dict[str, list[Link]]:
    """Return the links of each fruit."""
    by_fruit: dict[str, list[Link]] = {}
    for link in links:
        by_fruit.setdefault(link.fruit_id, []).append(link)
    return by_fruit


def measured_points(links: Sequence[Link]) -> list[Point]:
    """Return the measurements (day, length_m, sd_m) of one fruit's links, each once, in order."""
    starts = {(k.day0, k.length0_m, k.sd0_m) for k in links}
    return sorted(starts | {(k.day1, k.length1_m, k.sd1_m) for k in links})


def _fair(histories: list[list[Point]], prior: GrowthPrior) -> list[list[Point]]:
    """Return the fruit that would have been long enough for their first round at likely growth."""
    if not histories:
        return []
    growth, _ = LineSums.of(histories, prior.spreads, np.inf).slopes()
    likely_m = float(np.median(growth)) + _FASTEST_SD * prior.spreads.fruit
    fair = [
        points
        for points in histories
        if points[-1][1] - likely_m * (points[-1][0] - points[0][0]) > prior.shortest_m
    ]
    return fair if len(fair) >= _LEAST_FAIR * len(histories) else histories


def _fruit_variance(growth: NDArray[np.float64], error: NDArray[np.float64], prior: float) -> float:
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
