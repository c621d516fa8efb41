"""A fruit as last measured, its line of growth, and draws of its length on the coming days."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision_greenhouse.forecast.growth import (
    LineSums,
    length_of,
    links_by_fruit,
    measured_points,
    rate_share,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision_greenhouse.forecast.growth import Curve, Growth, Spreads

_EXACT_M = 1e-6  # standard deviation of a length that is known


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

    day: NDArray[np.float64]
    stage_m: NDArray[np.float64]
    growth_m: NDArray[np.float64]
    covariance: NDArray[np.float64]


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
    links = links_by_fruit(growth.links)
    histories = []
    for state in fruit:
        alone_var = max(state.sd_m**2 - (scale_sd * state.length_m) ** 2, (0.1 * state.sd_m) ** 2)
        past = measured_points(links[state.fruit_id]) if state.fruit_id in links else []
        last = (state.day, state.length_m, alone_var**0.5)
        histories.append([*(point for point in past if point[0] < state.day), last])
    sums = LineSums.of(histories, growth.prior.spreads, curve.full_m)
    # The house's growth is one more measurement of the slope.
    pull = curve.fruit_sd_m**-2
    day_day = sums.day_day + pull
    determinant = sums.weight * day_day - sums.day**2
    stage_m = day_day * sums.stage - sums.day * sums.day_stage, -pull * sums.day
    growth_m = sums.weight * sums.day_stage - sums.day * sums.stage, pull * sums.weight
    return FruitLines(
        day=np.array([state.day for state in fruit], np.float64),
        stage_m=np.array(stage_m) / determinant,
        growth_m=np.array(growth_m) / determinant,
        covariance=np.array([day_day, -sums.day, sums.weight]) / determinant,
    )


def lengths_today(
    fruit: Sequence[FruitState], growth: Growth, today: float, scale_sd: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
        mean_m += curve.weight * length_m
        squares += curve.weight * (length_m**2 + variance)
    return mean_m, np.sqrt(squares - mean_m**2 + (scale_sd * mean_m) ** 2)


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
        Of a newcomer.
    """
    spreads, drawn = growth.prior.spreads, []
    hanging = [*fruit, FruitState("", "", 0.0, shortest_m, _EXACT_M, today)]
    gap = np.array([today - state.day for state in hanging], np.float32)
    ends = np.round(draws * np.cumsum([0.0, *(c.weight for c in growth.curves)])).astype(int)
    [later] = rng.spawn(1)  # today's draws do not depend on the number of days
    for curve, count in zip(growth.curves, np.diff(ends).tolist(), strict=True):
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
    return lengths_m[..., :-1], lengths_m[..., -1]


def _step(
    growth_m: NDArray[np.float32],
    days: NDArray[np.float32] | np.float32,
    spreads: Spreads,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Draw how far fruit come in some days, (draws, N): never back."""
    step = rng.standard_normal(growth_m.shape, np.float32)
    step *= np.float32(spreads.fruit_day)
    step += (spreads.day * rng.standard_normal((len(step), 1))).astype(np.float32)
    step *= np.sqrt(days)
    step += days * growth_m
    return np.maximum(step, 0, out=step)
