"""Growth of a house, its rows and its fruit, by weighted means in closed form.

Lengths grow linearly, in metres a day, by

    pace + row + fruit,    row ~ N(0, row²),  fruit ~ N(0, fruit²)

with `pace` the growth of the house on the days that the links span, weather included. The weighted
line through a fruit's lengths measures its growth, with an error from the lengths' errors and the
day-to-day growth. On every level the posterior mean is that of what was measured and of the level
above, weighted by inverse variances (partial pooling: Gelman and Hill 2007, chapter 12). The
variance between fruit is estimated from their scatter by moments (DerSimonian and Laird 1986) and
pooled with the profile's. Without links everything is the profile's.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

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
_LEAST_SHARE = 0.04  # of the full growth, by which measured growth is divided


def rate_share(length_m: ArrayLike, full_m: float) -> NDArray[np.float64]:
    """Return the share of its full growth by which a fruit of this length grows, float64.

    It falls linearly from 1 at half of `full_m`, the length at which growth stops, to 0.

    Examples
    --------
    >>> rate_share([0.10, 0.20, 0.30, 0.50], full_m=0.40).round(6).tolist()
    [1.0, 1.0, 0.5, 0.0]
    """
    return np.clip(2 * (1 - np.asarray(length_m, np.float64) / full_m), 0.0, 1.0)


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
    full_m : float
        The length at which growth stops (`rate_share`); infinite for growth that does not slow.
    shortest_m : float
        The shortest length that is measured, metres.
    source : str
        Source of the figures.
    """

    mean_m: float
    spreads: Spreads
    full_m: float = float("inf")
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
        full_m = float("inf") if g.full_cm is None else g.full_cm / 100
        spreads = Spreads(*(figure / 100 for figure in cm))
        return cls(g.mean / 100, spreads, full_m, profile.accepted_m[0], g.source)


@dataclass(frozen=True, eq=False)
class LineSums:
    """Sums over the points of N fruit, float64, shape (N,): what a line through each needs.

    Days count from a fruit's last point, so that they are 0 or negative. A point's weight is the
    inverse of the variance of its length and of the day-to-day growth since then.

    Parameters
    ----------
    weight, day, day_day, length, day_length : ndarray
        Weighted sums of 1, day, day², length, and day times length.
    """

    weight: NDArray[np.float64]
    day: NDArray[np.float64]
    day_day: NDArray[np.float64]
    length: NDArray[np.float64]
    day_length: NDArray[np.float64]

    @classmethod
    def of(cls, histories: Sequence[Sequence[Point]], prior: GrowthPrior) -> LineSums:
        """Sum the points of each fruit, which are in order of days, at least one."""
        counts = [len(points) for points in histories]
        fruit = np.repeat(np.arange(len(counts)), counts)
        flat = np.array([p for points in histories for p in points], np.float64).reshape(-1, 3)
        day, length_m, sd_m = flat.T
        mean_m = np.bincount(fruit, length_m, len(counts)) / np.array(counts, np.float64)
        # Where growth slows, a fruit's days count for less.
        share = np.maximum(rate_share(mean_m, prior.full_m), _LEAST_SHARE)
        day = (day - day[np.cumsum(counts, dtype=np.intp) - 1][fruit]) * share[fruit]
        daily = prior.spreads.day**2 + prior.spreads.fruit_day**2
        weight = 1 / (sd_m**2 - daily * day)
        terms = (np.ones_like(day), day, day**2, length_m, day * length_m)
        sums = [np.bincount(fruit, weight * term, len(counts)) for term in terms]
        return cls(*(np.asarray(total, np.float64) for total in sums))


@dataclass(frozen=True, eq=False)
class Growth:
    """The posterior of growth, metres a day.

    Parameters
    ----------
    prior : GrowthPrior
        The prior.
    links : tuple of Link
        The links.
    pace_m, pace_sd_m : float
        Growth of the house on the days of the links, and its standard deviation.
    lasting : float
        Share of the pace's deviation from the prior that is the house's; the rest is weather.
    lasting_sd_m : float
        Standard deviation of the house's growth, given the pace.
    fruit_sd_m : float
        Standard deviation between the fruit of a row.
    rows : mapping of str to (float, float)
        Of each row with links: mean growth of its fruit, and the weight of that against the pace.
    """

    prior: GrowthPrior
    links: tuple[Link, ...]
    pace_m: float
    pace_sd_m: float
    lasting: float
    lasting_sd_m: float
    fruit_sd_m: float
    rows: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def mean_m(self) -> float:
        """Mean growth of the house from today on."""
        return self.prior.mean_m + self.lasting * (self.pace_m - self.prior.mean_m)

    @property
    def mean_sd_m(self) -> float:
        """Standard deviation of `mean_m`."""
        return float(np.hypot(self.lasting * self.pace_sd_m, self.lasting_sd_m))


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
    3.8
    """
    spreads = prior.spreads
    by_fruit = links_by_fruit(links)
    histories = [measured_points(group) for group in by_fruit.values()]
    if not histories:
        return Growth(
            prior=prior,
            links=(),
            pace_m=prior.mean_m,
            pace_sd_m=spreads.house,
            lasting=1.0,
            lasting_sd_m=0.0,
            fruit_sd_m=spreads.fruit,
        )
    sums = LineSums.of(histories, prior)
    spread = sums.weight * sums.day_day - sums.day**2
    growth = (sums.weight * sums.day_length - sums.day * sums.length) / spread
    error = sums.weight / spread
    fair = _is_fair(histories, growth, prior)
    growth, error = growth[fair], error[fair]
    all_rows = np.array([group[0].row for group in by_fruit.values()])
    names, row = np.unique(all_rows[fair], return_inverse=True)
    fruit_var = _fruit_variance(growth, error, row, spreads.fruit**2)
    weight = 1 / (fruit_var + error)
    row_weight = np.bincount(row, weight)
    row_growth = np.bincount(row, weight * growth) / row_weight
    # What the fruit of a row, and of a day, have in common does not average out over fruit.
    house_weight = 1 / (spreads.row**2 + 1 / row_weight)
    measured_m, measured_var = np.average(row_growth, weights=house_weight), 1 / house_weight.sum()
    days = max(link.day1 for link in links) - min(link.day0 for link in links)
    pace_var = spreads.house**2 + spreads.day**2 / days
    share = pace_var / (pace_var + measured_var)
    lasting = spreads.house**2 / pace_var
    row_share = spreads.row**2 * house_weight
    rows = zip(names.tolist(), row_growth.tolist(), row_share.tolist(), strict=True)
    return Growth(
        prior=prior,
        links=tuple(links),
        pace_m=float(prior.mean_m + share * (measured_m - prior.mean_m)),
        pace_sd_m=float(np.sqrt(share * measured_var)),
        lasting=lasting,
        lasting_sd_m=float(spreads.house * np.sqrt(1 - lasting)),
        fruit_sd_m=float(np.sqrt(fruit_var)),
        rows={name: (mean_m, weight) for name, mean_m, weight in rows},
    )


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


def _is_fair(
    histories: Sequence[Sequence[Point]], growth: NDArray[np.float64], prior: GrowthPrior
) -> NDArray[np.bool_]:
    """Return which fruit would have been long enough for their first round at any likely growth."""
    likely_m = float(np.median(growth)) + _FASTEST_SD * prior.spreads.fruit
    first_m = [points[-1][1] - likely_m * (points[-1][0] - points[0][0]) for points in histories]
    is_fair = np.array(first_m) > prior.shortest_m
    return is_fair if is_fair.mean() >= _LEAST_FAIR else np.ones_like(is_fair)


def _fruit_variance(
    growth: NDArray[np.float64], error: NDArray[np.float64], row: NDArray[np.intp], prior: float
) -> float:
    """Return the variance of growth between the fruit of a row, from their growth and its errors.

    A residual's square has the expectation (variance + error) times its freedom, 1 less the fruit's
    share of its row's mean: the only fruit of a row tells nothing.
    """
    weight = 1 / (prior + error)
    row_weight = np.bincount(row, weight)
    residual = growth - (np.bincount(row, weight * growth) / row_weight)[row]
    freedom = 1 - weight / row_weight[row]
    information = (prior * weight) ** 2
    scatter = float((information * (residual**2 - freedom * error)).sum())
    variance = (_PRIOR_FRUIT * prior + scatter) / (
        _PRIOR_FRUIT + float((information * freedom).sum())
    )
    return max(variance, _LEAST_VARIANCE * prior)
