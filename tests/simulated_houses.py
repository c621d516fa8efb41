"""Simulated houses of known truth: lengths that grow, are measured and forecast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cucumbervision.arrays import Array
from cucumbervision_greenhouse.forecast.growth import FruitState, Spreads, rate_share


@dataclass(frozen=True)
class HouseSettings:
    """What to simulate.

    Parameters
    ----------
    mean_m : float
        Growth of this very house, metres a day; `spreads.house` is not used.
    spreads : Spreads
        Between rows, fruit, days, and a fruit's days; metres a day.
    rows, fruit_per_row : int
        True fruit, those too small to be measured included.
    visits : tuple of int
        Days of the rounds; the last is 0, today.
    links : int
        Fruit whose earlier lengths the forecast gets to see, at most; chosen at random.
    found : float
        Share of fruit that a round finds.
    relative_sd, floor_sd_m : float
        Measuring error: a share of the length, and a floor.
    scale_sd : float
        Relative error that all lengths of the house share.
    days : int
        Days ahead.
    youngest_m, oldest_m : float
        Lengths today are uniform between these; below 0 the fruit is yet to set.
    shortest_m : float
        Fruit below are not measured.
    full_m : float
        The length at which growth would stop, as in `Curve`. Infinite: it does not slow.
    """

    mean_m: float
    spreads: Spreads
    rows: int = 10
    fruit_per_row: int = 100
    visits: tuple[int, ...] = (-4, -2, 0)
    links: int = 500
    found: float = 0.95
    relative_sd: float = 0.02
    floor_sd_m: float = 0.002
    scale_sd: float = 0.0
    days: int = 7
    youngest_m: float = -0.30
    oldest_m: float = 0.33
    shortest_m: float = 0.05
    full_m: float = float("inf")


@dataclass(frozen=True, eq=False)
class SimulatedHouse:
    """A house: what was measured, and what is true.

    Parameters
    ----------
    fruit : tuple of FruitState
        As found today.
    lengths_m : ndarray of float64, shape (D, N)
        True lengths of all N fruit today and later.
    row : ndarray of int64, shape (N,)
        Row of each true fruit; its name is the number.
    of_fruit : ndarray of int64, shape (len(fruit),)
        The true fruit behind each found one.
    """

    fruit: tuple[FruitState, ...]
    lengths_m: Array
    row: NDArray[np.int64]
    of_fruit: NDArray[np.int64]


def simulate_house(settings: HouseSettings, seed: int) -> SimulatedHouse:
    """Simulate a house.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.growth import Spreads
    >>> spreads = Spreads(0.006, 0.002, 0.005, 0.003, 0.003)
    >>> house = simulate_house(HouseSettings(0.03, spreads, links=20), seed=1)
    >>> house.lengths_m.shape, sum(bool(fruit.earlier) for fruit in house.fruit)
    ((8, 1000), 20)
    """
    rng = np.random.default_rng(seed)
    s = settings
    row = np.repeat(np.arange(s.rows), s.fruit_per_row)
    rate = (
        s.mean_m
        + (s.spreads.row * rng.standard_normal(s.rows))[row]
        + s.spreads.fruit * rng.standard_normal(len(row))
    )
    lengths = {0: rng.uniform(s.youngest_m, s.oldest_m, len(row))}
    for day in range(s.days):
        lengths[day + 1] = lengths[day] + _increment(s, rate, lengths[day], rng)
    for day in range(0, min(s.visits), -1):
        lengths[day - 1] = lengths[day] - _increment(s, rate, lengths[day], rng, -1)
    scale = np.exp(s.scale_sd * rng.standard_normal())
    rounds = {day: _measured(s, lengths[day], float(scale), rng) for day in s.visits}
    fruit, of_fruit = _states(s, rounds, row, rng)
    truth = np.stack([lengths[day] for day in range(s.days + 1)])
    return SimulatedHouse(fruit, truth, row, of_fruit)


def _increment(
    s: HouseSettings, rate: Array, length: Array, rng: np.random.Generator, direction: int = 1
) -> Array:
    luck = s.spreads.fruit_day * rng.standard_normal(len(rate))
    step = np.maximum(rate + s.spreads.day * rng.standard_normal() + luck, 0.0)
    # The day's growth at the length of its middle, forwards and backwards alike.
    middle = length + direction * step * rate_share(length, s.full_m) / 2
    return np.asarray(step * rate_share(middle, s.full_m), np.float64)


def _measured(s: HouseSettings, length: Array, scale: float, rng: np.random.Generator) -> Array:
    """Return measured lengths, NaN where the fruit was missed or is too small."""
    sd = np.hypot(s.relative_sd * length, s.floor_sd_m)
    read = scale * (length + sd * rng.standard_normal(len(length)))
    seen = (rng.random(len(length)) < s.found) & (read >= s.shortest_m)
    return np.where(seen, read, np.nan)


def _sd(s: HouseSettings, read: float) -> float:
    """Return the standard deviation as the intervals say it: the shared error is part of it."""
    return float(np.hypot(np.hypot(s.relative_sd, s.scale_sd) * read, s.floor_sd_m))


def _states(
    s: HouseSettings, rounds: dict[int, Array], row: NDArray[np.int64], rng: np.random.Generator
) -> tuple[tuple[FruitState, ...], NDArray[np.int64]]:
    read, before = rounds[0], np.array([rounds[day] for day in s.visits[:-1]])
    seen = np.flatnonzero(~np.isnan(read))
    linked = np.flatnonzero(~np.isnan(read) & ~np.isnan(before).all(axis=0))
    known = set(rng.permutation(linked)[: s.links].tolist())
    states = tuple(
        FruitState(
            str(true),
            str(row[true]),
            round(float(rng.uniform(0, 50)), 2),
            float(read[true]),
            _sd(s, float(read[true])),
            earlier=tuple(
                (day, float(length), _sd(s, float(length)))
                for day, length in zip(s.visits[:-1], before[:, true], strict=True)
                if true in known and length > 0
            ),
        )
        for true in seen.tolist()
    )
    return states, seen.astype(np.int64)
