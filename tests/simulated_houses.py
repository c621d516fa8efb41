"""Simulated houses of known truth: lengths that grow, are measured and forecast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cucumbervision_greenhouse.forecast.growth import Link, Spreads, rate_share
from cucumbervision_greenhouse.forecast.length_draws import FruitState


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
        Links that the forecast gets to see, at most; fruit are chosen at random.
    found, false : float
        Share of fruit that a round finds, and of false positives among the detections.
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
    false: float = 0.02
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
    links : tuple of Link
        Between rounds.
    lengths_m : ndarray of float64, shape (D, N)
        True lengths of all N fruit today and later.
    row : ndarray of int64, shape (N,)
        Row of each true fruit; its name is the number.
    of_fruit : ndarray of int64, shape (len(fruit),)
        The true fruit behind each found one, -1 for a false positive.
    """

    fruit: tuple[FruitState, ...]
    links: tuple[Link, ...]
    lengths_m: NDArray[np.float64]
    row: NDArray[np.int64]
    of_fruit: NDArray[np.int64]


def simulate_house(settings: HouseSettings, seed: int) -> SimulatedHouse:
    """Simulate a house.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.growth import Spreads
    >>> spreads = Spreads(0.006, 0.002, 0.005, 0.003, 0.003)
    >>> house = simulate_house(HouseSettings(0.03, spreads, links=20), seed=1)
    >>> house.lengths_m.shape, len(house.links)
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
    fruit, of_fruit = _states(s, rounds[0], row, rng)
    truth = np.stack([lengths[day] for day in range(s.days + 1)])
    return SimulatedHouse(fruit, _links(s, rounds, row, rng), truth, row, of_fruit)


def _increment(
    s: HouseSettings,
    rate: NDArray[np.float64],
    length: NDArray[np.float64],
    rng: np.random.Generator,
    direction: int = 1,
) -> NDArray[np.float64]:
    luck = s.spreads.fruit_day * rng.standard_normal(len(rate))
    step = np.maximum(rate + s.spreads.day * rng.standard_normal() + luck, 0.0)
    # The day's growth at the length of its middle, forwards and backwards alike.
    middle = length + direction * step * rate_share(length, s.full_m) / 2
    return np.asarray(step * rate_share(middle, s.full_m), np.float64)


def _measured(
    s: HouseSettings, length: NDArray[np.float64], scale: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return measured lengths, NaN where the fruit was missed or is too small."""
    sd = np.hypot(s.relative_sd * length, s.floor_sd_m)
    read = scale * (length + sd * rng.standard_normal(len(length)))
    seen = (rng.random(len(length)) < s.found) & (read >= s.shortest_m)
    return np.where(seen, read, np.nan)


def _sd(s: HouseSettings, read: float) -> float:
    """Return the standard deviation as the intervals say it: the shared error is part of it."""
    return float(np.hypot(np.hypot(s.relative_sd, s.scale_sd) * read, s.floor_sd_m))


def _states(
    s: HouseSettings, read: NDArray[np.float64], row: NDArray[np.int64], rng: np.random.Generator
) -> tuple[tuple[FruitState, ...], NDArray[np.int64]]:
    seen = np.flatnonzero(~np.isnan(read))
    false = rng.random(len(seen)) < s.false / (1 - s.false)
    of_fruit = np.concatenate([seen, np.full(int(false.sum()), -1)])
    like = np.concatenate([seen, rng.choice(seen, int(false.sum()))])
    states = tuple(
        FruitState(
            str(true) if true >= 0 else f"false {k}",
            str(row[of]),
            round(float(rng.uniform(0, 50)), 2),
            float(read[of]),
            _sd(s, float(read[of])),
        )
        for k, (true, of) in enumerate(zip(of_fruit, like, strict=True))
    )
    return states, of_fruit.astype(np.int64)


def _links(
    s: HouseSettings,
    rounds: dict[int, NDArray[np.float64]],
    row: NDArray[np.int64],
    rng: np.random.Generator,
) -> tuple[Link, ...]:
    found = []
    for day0, day1 in zip(s.visits[:-1], s.visits[1:], strict=True):
        before, after = rounds[day0], rounds[day1]
        for k in np.flatnonzero(~np.isnan(before + after)):
            a, b = float(before[k]), float(after[k])
            found.append(Link(str(k), str(row[k]), day0, a, _sd(s, a), day1, b, _sd(s, b)))
    chosen = rng.permutation(len(found))[: s.links]
    return tuple(found[k] for k in chosen)
