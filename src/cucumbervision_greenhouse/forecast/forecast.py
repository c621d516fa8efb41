"""Forecast the number of fruit per class for the next days, from drawn lengths of every fruit."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cucumbervision.arrays import Array, Array32, Mask
from cucumbervision.crop.grades import NO_CLASS, possible_classes
from cucumbervision.crop.profiles import CropProfile
from cucumbervision.methods.result import INTERVAL_Z
from cucumbervision_greenhouse.forecast.growth import (
    FruitState,
    Growth,
    draw_lengths,
    lengths_today,
)


@lru_cache(maxsize=4096)  # a house has few rows, and many fruit in each
def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a natural sort key: row 2 before row 10.

    Examples
    --------
    >>> sorted(["row 10", "row 2", "A"], key=natural_key)
    ['A', 'row 2', 'row 10']
    """
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts)


_SURELY_COMPLETE = 0.10  # largest probability that a fruit too small to be detected reaches a class


@dataclass(frozen=True, eq=False)
class Counts:
    """Number of fruit: mean and interval. Arrays of the same shape, float64."""

    expected: Array
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class Forecast:
    """Forecast for N fruit in R rows over D days, including today (day 0).

    Counts leave out picked fruit; the expected number in a class is the sum of the probabilities.

    Parameters
    ----------
    today : float
        Day 0, counted as in the fruit.
    days : ndarray of int64, shape (D,)
        0 to the last day.
    classes : tuple of str, length C
        The profile's classes, best first, then 'too short' and 'too long'.
    pick : tuple of str
        The classes that are ready to be picked.
    rows : tuple of str, length R
        In walking order.
    fruit : tuple of FruitState, length N
        By row.
    possible : tuple of tuple of str, length N
        The classes that each may be in today: one where it is decided (`grades.possible_classes`).
    length_m : ndarray of float64, shape (N,)
        Expected lengths today, metres.
    probability : ndarray of float64, shape (N, D, C)
        Of each class on each day if not picked; Monte Carlo error about 0.5 / sqrt(draws).
    house, by_row : Counts, shapes (D, C) and (R, D, C)
        Fruit in each class if nothing is picked.
    picks, row_picks : Counts, shapes (D, C) and (R, D, C)
        Fruit that become ready on that day, by class: the picks if every ready fruit is picked
        every day.
    picked_by : Counts, shape (D, 1)
        Fruit that become ready up to that day, of all classes that are picked.
    complete : ndarray of bool, shape (D, C)
        Whether only fruit seen today can be in that class on that day. If not, add fruit that are
        too small to be measured today.
    growth : Growth
        The growth that the fruit are expected to have.
    """

    today: float
    days: NDArray[np.int64]
    classes: tuple[str, ...]
    pick: tuple[str, ...]
    rows: tuple[str, ...]
    fruit: tuple[FruitState, ...]
    possible: tuple[tuple[str, ...], ...]
    length_m: Array
    probability: Array
    house: Counts
    by_row: Counts
    picks: Counts
    row_picks: Counts
    picked_by: Counts
    complete: Mask
    growth: Growth

    def ready(self, day: int = 0) -> Array:
        """Return the probability that each fruit is ready on a day, shape (N,), float64."""
        chosen = [self.classes.index(name) for name in self.pick]
        return np.asarray(self.probability[:, day, chosen].sum(axis=1), np.float64)


def forecast(
    fruit: Sequence[FruitState],
    growth: Growth,
    profile: CropProfile,
    days: int = 7,
    seed: int = 0,
    *,
    today: float | None = None,
    scale_sd: float = 0.0,
    draws: int = 320,
    level: float = 0.8,
) -> Forecast:
    """Forecast the classes of fruit.

    Parameters
    ----------
    fruit : sequence of FruitState
        The fruit; picked ones have probabilities, and are in no count.
    growth : Growth
        The posterior of growth. A fruit with earlier lengths is forecast by its own growth.
    profile : CropProfile
        Classes, and which of them are picked.
    days : int
        Days ahead.
    seed : int
        Seed of the random draws.
    today : float, optional
        Day 0; by default the latest day of the fruit. Earlier measurements are extrapolated to it.
    scale_sd : float
        Relative standard deviation of an error common to all lengths: the camera's depth scale,
        0.01 until it was calibrated. It is subtracted from each fruit's own variance.
    draws : int
        Draws from the posterior.
    level : float
        Of the intervals.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.growth import GrowthPrior, fit_growth
    >>> from cucumbervision.crop.profiles import load_profile
    >>> profile = load_profile("long-cucumber")
    >>> growth = fit_growth([], GrowthPrior.of(profile))
    >>> fruit = [FruitState(str(k), "1", 0.1 * k, 0.22, 0.004) for k in range(50)]
    >>> week = forecast(fruit, growth, profile)
    >>> week.classes
    ('I', 'II', 'too short', 'too long')
    >>> week.house.expected[0].tolist()  # all are class II today
    [0.0, 50.0, 0.0, 0.0]
    >>> bool(week.house.expected[2, 0] > 40)  # most are class I in two days
    True
    """
    states = sorted(fruit, key=lambda f: (natural_key(f.row), f.side, f.position_m, f.fruit_id))
    day_0 = max((f.day for f in fruit), default=0.0) if today is None else today
    rng = np.random.default_rng(seed)
    lengths_m, newcomer_m, share = draw_lengths(
        states, growth, day_0, days, draws, scale_sd, rng, profile.accepted_m[0]
    )
    _resemble_longer(lengths_m, states, rng)
    class_of_draw = _classes(lengths_m, states, profile)
    ready = np.array([name in profile.pick for name in profile.outcomes]).take(class_of_draw)
    newly = ready.copy()
    newly[1:] &= ~np.logical_or.accumulate(ready, axis=0)[:-1]
    hanging = np.array([not f.picked for f in states], bool)
    row_of = [f.row for f in states]
    rows = tuple(dict.fromkeys(row_of))
    spans = list(pairwise([*(row_of.index(row) for row in rows), len(states)]))
    shares: list[Array] = []
    standing: list[NDArray[np.int64]] = []
    picked: list[NDArray[np.int64]] = []
    for k in range(len(profile.outcomes)):
        members = class_of_draw == k
        shares.append(np.stack([share @ of_day for of_day in members]).round(9))
        members &= hanging
        for counts, which in ((standing, members), (picked, members & newly)):
            of_rows = [np.count_nonzero(which[..., slice(*span)], axis=2) for span in spans]
            counts.append(np.stack([np.zeros(which.shape[:2], int), *of_rows], axis=2)[..., 1:])
    picked_by = np.cumsum(np.sum(picked, axis=(0, 3)), axis=0)
    mean_m, sd_m = lengths_today(states, growth, day_0, scale_sd)
    return Forecast(
        day_0,
        np.arange(days + 1),
        profile.outcomes,
        profile.pick,
        rows,
        tuple(states),
        _possible_today(states, day_0, mean_m, sd_m, profile),
        mean_m,
        np.stack(shares, axis=2).transpose(1, 0, 2),
        *_counts(np.stack(standing, axis=3), share, level, rng),
        *_counts(np.stack(picked, axis=3), share, level, rng),
        _counts(picked_by[..., None, None], share, level, rng)[0],
        _complete(newcomer_m, profile),
        growth,
    )


def _resemble_longer(
    lengths_m: Array32, fruit: Sequence[FruitState], rng: np.random.Generator
) -> None:
    """Give each fruit with a lower bound the drawn lengths of whole fruit that are as long."""
    measured_m = np.array([0.0 if f.at_least else f.length_m for f in fruit])
    draw = np.arange(lengths_m.shape[1])
    for k, state in enumerate(fruit):
        (longer,) = np.nonzero(measured_m > state.length_m)
        if state.at_least and len(longer):
            lengths_m[:, :, k] = lengths_m[:, draw, rng.choice(longer, len(draw))]


def _classes(
    lengths_m: Array32, fruit: Sequence[FruitState], profile: CropProfile
) -> NDArray[np.int8]:
    """Return the index of the class of each drawn length, no better than a fruit's shape allows."""
    bins = np.zeros(lengths_m.shape, np.int8)
    for edge in profile.edges_m.astype(np.float32):
        bins += lengths_m >= edge
    names = [c.name for c in profile.classes]
    best = np.array([names.index(f.best_class) if f.best_class else 0 for f in fruit], np.int8)
    class_of_bin = np.array(profile.outcome_of_bin, np.int8).take(bins)
    graded = np.where(class_of_bin < len(names), np.maximum(class_of_bin, best), class_of_bin)
    graded[..., [f.possible == (NO_CLASS,) for f in fruit]] = -1
    return graded


def _possible_today(
    fruit: Sequence[FruitState], today: float, mean_m: Array, sd_m: Array, profile: CropProfile
) -> tuple[tuple[str, ...], ...]:
    """Return the classes that each fruit may be in today.

    On the day of its measurement these are the fruit's own classes; later, those that its interval
    spans after growth. A fruit in no class, or possibly in any, stays so.
    """
    names, outcomes, possible = [c.name for c in profile.classes], profile.outcomes, []
    for state, low_m, high_m in zip(
        fruit, mean_m - INTERVAL_Z * sd_m, mean_m + INTERVAL_Z * sd_m, strict=True
    ):
        is_settled = state.possible == (NO_CLASS,) or {*state.possible} >= {*outcomes}
        if state.possible and (state.day >= today or is_settled):
            possible.append(state.possible)
            continue
        best = names.index(state.best_class) if state.best_class else 0
        bins = [max(n, best) if n < len(names) else n for n in profile.outcome_of_bin]
        ends = float(low_m), math.inf if state.at_least else float(high_m)
        by_bin = [outcomes[n] for n in bins]
        possible.append(possible_classes(*ends, profile.edges_m, by_bin))
    return tuple(possible)


def _counts(
    drawn: NDArray[np.integer], share: Array, level: float, rng: np.random.Generator
) -> tuple[Counts, Counts]:
    """Return the house's and the rows' counts of draws, (D, draws, R, C); their mean by shares."""
    ends = [0.5 - level / 2, 0.5 + level / 2]
    house_and_rows = []
    for counts in (drawn.sum(axis=2), drawn):
        # Jitter by half a fruit: the whole numbers in the interval then cover `level` on average,
        # where plain quantiles of small counts would cover far more. Today first: it is
        # independent of the number of days.
        jittered = counts + rng.uniform(-0.5, 0.5, counts.shape)
        low_count, high_count = np.quantile(jittered, ends, axis=1)
        mean = np.tensordot(counts, share, (1, 0)).round(9)
        # Whole numbers around the mean.
        low_count = np.minimum(np.ceil(low_count), np.floor(mean)) + 0.0
        high_count = np.maximum(np.floor(high_count), np.ceil(mean))
        arrays = (mean, low_count, high_count)
        house_and_rows.append(Counts(*(np.moveaxis(x, 0, -2) for x in arrays)))
    return house_and_rows[0], house_and_rows[1]


def _complete(newcomer_m: Array32, profile: CropProfile) -> Mask:
    """Return for each day and class whether no fruit too small today can be in it, (D, C)."""
    entries = [*(c.min_cm / 100 for c in profile.classes), np.inf, profile.edges_m[-1]]
    reach = [(newcomer_m >= entry).mean(axis=1) for entry in entries]
    complete = np.stack(reach, axis=1) <= _SURELY_COMPLETE
    complete[1:, len(profile.classes)] = False  # new fruit join 'too short' every day
    return complete
