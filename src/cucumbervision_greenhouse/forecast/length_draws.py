"""A fruit as last measured, its line of growth, and draws of its length on the coming days."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision_greenhouse.forecast.growth import (
    LineSums,
    links_by_fruit,
    measured_points,
    rate_share,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision_greenhouse.forecast.growth import Growth


@dataclass(frozen=True)
class FruitState:
    """The last measurement of one fruit.

    Parameters
    ----------
    fruit_id : str
        Fruit identifier, the same as in growth links.
    row : str
        Its row.
    position_m : float
        Along the row, metres.
    length_m, sd_m : float
        The length that the profile grades by, and its standard deviation, metres;
        `LengthBelief.sd_m` computes it from an interval.
    day : float
        Day of the measurement, counted as in the links.
    side : str
        Side of the row.
    best_class : str
        The best class that its shape allows, as `Grade.best_class` gives it; empty for any.
    picked : bool
        Whether it has been picked.
    possible : tuple of str
        The classes that it may be in on its day, as `Grade.possible` gives them; by default those
        that its 90 % interval spans.
    at_least : bool
        Whether the length is a lower bound.
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


@dataclass(frozen=True, eq=False)
class FruitLines:
    """The posterior of N fruit's last length and growth, given the growth g of their rows.

    Parameters
    ----------
    day : ndarray of float64, shape (N,)
        Of the last length.
    length_m, growth_m : ndarray of float64, shape (2, N)
        Means: the first line plus the second times g; metres, metres a day.
    covariance : ndarray of float64, shape (3, N)
        Variance of the length, covariance, variance of the growth.
    row_growth_m, row_weight : ndarray of float64, shape (N,)
        Measured growth of each fruit's row, and its weight against the house's pace; 0 without.
    """

    day: NDArray[np.float64]
    length_m: NDArray[np.float64]
    growth_m: NDArray[np.float64]
    covariance: NDArray[np.float64]
    row_growth_m: NDArray[np.float64]
    row_weight: NDArray[np.float64]


def fruit_lines(fruit: Sequence[FruitState], growth: Growth, scale_sd: float) -> FruitLines:
    """Return the line of each fruit through its lengths, its slope pooled with its row's growth.

    Parameters
    ----------
    fruit, growth, scale_sd
        As `draw_lengths` takes them.
    """
    links = links_by_fruit(growth.links)
    histories = []
    for state in fruit:
        alone_var = max(state.sd_m**2 - (scale_sd * state.length_m) ** 2, (0.1 * state.sd_m) ** 2)
        past = measured_points(links[state.fruit_id]) if state.fruit_id in links else []
        last = (state.day, state.length_m, alone_var**0.5)
        histories.append([*(point for point in past if point[0] < state.day), last])
    sums = LineSums.of(histories, growth.prior)
    # The row's growth is one more measurement of the slope.
    pull = growth.fruit_sd_m**-2
    day_day = sums.day_day + pull
    determinant = sums.weight * day_day - sums.day**2
    length_m = day_day * sums.length - sums.day * sums.day_length, -pull * sums.day
    growth_m = sums.weight * sums.day_length - sums.day * sums.length, pull * sums.weight
    rows = np.array([growth.rows.get(state.row, (0.0, 0.0)) for state in fruit]).reshape(-1, 2)
    return FruitLines(
        day=np.array([state.day for state in fruit], np.float64),
        length_m=np.array(length_m) / determinant,
        growth_m=np.array(growth_m) / determinant,
        covariance=np.array([day_day, -sums.day, sums.weight]) / determinant,
        row_growth_m=rows[:, 0],
        row_weight=rows[:, 1],
    )


def lengths_today(
    fruit: Sequence[FruitState], growth: Growth, today: float, scale_sd: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean and standard deviation of each length today, metres, (N,)."""
    lines, prior = fruit_lines(fruit, growth, scale_sd), growth.prior
    days = (today - lines.day) * rate_share(lines.length_m[0], prior.full_m)
    pull = growth.pace_m + lines.row_weight * (lines.row_growth_m - growth.pace_m)
    # The derivatives of the length by the row's growth and by the house's pace.
    by_row = lines.length_m[1] + days * lines.growth_m[1]
    by_pace = by_row * (1 - lines.row_weight) + days * (growth.lasting - 1)
    mean_m = lines.length_m[0] + by_row * pull
    mean_m += days * (lines.growth_m[0] + growth.mean_m - growth.pace_m)
    of_length, shared, of_growth = lines.covariance
    daily = prior.spreads.day**2 + prior.spreads.fruit_day**2
    variance = of_length + 2 * days * shared + days**2 * of_growth + days * daily
    variance += by_row**2 * prior.spreads.row**2 * (1 - lines.row_weight)
    variance += (by_pace * growth.pace_sd_m) ** 2 + (days * growth.lasting_sd_m) ** 2
    return mean_m, np.sqrt(variance + (scale_sd * mean_m) ** 2)


def draw_lengths(
    fruit: Sequence[FruitState],
    growth: Growth,
    today: float,
    days: int,
    draws: int,
    scale_sd: float,
    rng: np.random.Generator,
    shortest_m: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
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
    newcomer_m : ndarray of float32, shape (days + 1, draws)
        Of a newcomer in a row without links.
    """
    lines, spreads = fruit_lines(fruit, growth, scale_sd), growth.prior.spreads
    [later] = rng.spawn(1)  # today's draws do not depend on the number of days
    length_m, growth_m, newcomer_growth_m = _drawn_lines(fruit, lines, growth, draws, rng)
    length_m = np.pad(length_m, ((0, 0), (0, 1)), constant_values=shortest_m)
    growth_m = np.column_stack([growth_m, newcomer_growth_m.astype(np.float32)])

    def grow(start_m: NDArray[np.float32], elapsed: NDArray[np.float32]) -> NDArray[np.float32]:
        step = later.standard_normal(start_m.shape, np.float32)
        step *= np.float32(spreads.fruit_day)
        step += (spreads.day * later.standard_normal((draws, 1))).astype(np.float32)
        step *= np.sqrt(elapsed)
        step += elapsed * growth_m
        np.maximum(step, 0, out=step)
        if np.isfinite(growth.prior.full_m):
            step *= rate_share(start_m, growth.prior.full_m).astype(np.float32)
        step += start_m
        return step

    gap = (today - np.append(lines.day, today)).astype(np.float32)
    lengths_m = np.empty((days + 1, *length_m.shape), np.float32)
    lengths_m[0] = grow(length_m, gap) if gap.any() else length_m
    for day in range(days):
        lengths_m[day + 1] = grow(lengths_m[day], np.ones(1, np.float32))
    lengths_m *= np.exp(scale_sd * rng.standard_normal((draws, 1))).astype(np.float32)
    return lengths_m[..., :-1], lengths_m[..., -1]


def _drawn_lines(
    fruit: Sequence[FruitState],
    lines: FruitLines,
    growth: Growth,
    draws: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """Draw each fruit's last length and growth, (draws, N), and the growth of a newcomer."""
    spreads, prior = growth.prior.spreads, growth.prior
    names = list(dict.fromkeys(state.row for state in fruit))
    row = np.array([names.index(state.row) for state in fruit], np.intp)
    pace_m = growth.pace_m + growth.pace_sd_m * rng.standard_normal(draws)
    house_m = prior.mean_m + growth.lasting * (pace_m - prior.mean_m)
    house_m += growth.lasting_sd_m * rng.standard_normal(draws)
    row_sd_m = (spreads.row * np.sqrt(1 - lines.row_weight)).astype(np.float32)
    row_luck = rng.standard_normal((draws, len(names)), np.float32)[:, row]
    row_m = pace_m.astype(np.float32)[:, None] * (1 - lines.row_weight).astype(np.float32)
    row_m += (lines.row_weight * lines.row_growth_m).astype(np.float32) + row_sd_m * row_luck
    length, slope, cov = (
        part.astype(np.float32) for part in (lines.length_m, lines.growth_m, _root(lines))
    )
    first, second = rng.standard_normal((2, *row_m.shape), np.float32)
    length_m = length[0] + length[1] * row_m + cov[0] * first
    growth_m = slope[0] + slope[1] * row_m + cov[1] * first + cov[2] * second
    growth_m += (house_m - pace_m).astype(np.float32)[:, None]
    newcomer_sd_m = np.hypot(spreads.row, growth.fruit_sd_m)
    return length_m, growth_m, house_m + newcomer_sd_m * rng.standard_normal(draws)


def _root(lines: FruitLines) -> NDArray[np.float64]:
    """Return the Cholesky factor of each fruit's covariance: its three figures, shape (3, N)."""
    of_length, shared, of_growth = lines.covariance
    sd_m = np.sqrt(of_length)
    shared = shared / sd_m
    return np.array([sd_m, shared, np.sqrt(np.maximum(of_growth - shared**2, 0.0))])
