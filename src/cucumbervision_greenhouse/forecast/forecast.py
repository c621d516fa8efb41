"""Forecast the number of fruit per class for the next days, from drawn lengths of every fruit."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.crop.grades import NO_CLASS, possible_classes
from cucumbervision.methods.result import INTERVAL_Z
from cucumbervision_greenhouse.forecast.length_draws import FruitState, draw_lengths, lengths_today

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.crop.profiles import CropProfile
    from cucumbervision_greenhouse.forecast.growth import Growth


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


@dataclass(frozen=True)
class DetectionRates:
    """Detection rates of the camera.

    Parameters
    ----------
    found, found_sd : float
        Share of the fruit that are found, and its standard deviation.
    false : float
        Share of the detections that are false positives or duplicates.
    """

    found: float = 1.0
    found_sd: float = 0.0
    false: float = 0.0


@dataclass(frozen=True, eq=False)
class Counts:
    """Number of fruit: mean and interval. Arrays of the same shape, float64."""

    expected: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Forecast:
    """Forecast for N fruit in R rows over D days, including today (day 0).

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
        Fruit on the plant, by row, without picked ones.
    possible : tuple of tuple of str, length N
        The classes that each may be in today: one where it is decided (`classes.possible_classes`).
    probability : ndarray of float64, shape (N, D, C)
        Of each class on each day if not picked; Monte Carlo error about 0.5 / sqrt(draws).
    house, by_row : Counts, shapes (D, C) and (R, D, C)
        Fruit in each class if nothing is picked.
    picks, row_picks : Counts, shapes (D, C) and (R, D, C)
        Fruit that become ready on that day, by class: the picks if every ready fruit is picked
        every day.
    complete : ndarray of bool, shape (D, C)
        Whether only fruit seen today can be in that class on that day. If not, add fruit that are
        too small to be measured today.
    level : float
        Of the intervals.
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
    probability: NDArray[np.float64]
    house: Counts
    by_row: Counts
    picks: Counts
    row_picks: Counts
    complete: NDArray[np.bool_]
    level: float
    growth: Growth

    @property
    def ready(self) -> NDArray[np.float64]:
        """Probability that each fruit is ready today, shape (N,), float64."""
        return np.asarray(self.probability[:, 0, self._picked].sum(axis=1), np.float64)

    @property
    def _picked(self) -> list[int]:
        return [self.classes.index(name) for name in self.pick]


def forecast(
    fruit: Sequence[FruitState],
    growth: Growth,
    profile: CropProfile,
    days: int = 7,
    seed: int = 0,
    *,
    today: float | None = None,
    detection: DetectionRates | None = None,
    scale_sd: float = 0.0,
    draws: int = 320,
    level: float = 0.8,
) -> Forecast:
    """Forecast the classes of fruit.

    Parameters
    ----------
    fruit : sequence of FruitState
        The fruit; picked ones are ignored.
    growth : Growth
        The posterior of growth. A fruit with links is forecast by its own growth.
    profile : CropProfile
        Classes, and which of them are picked.
    days : int
        Days ahead.
    seed : int
        Seed of the random draws.
    today : float, optional
        Day 0; by default the latest day of the fruit. Earlier measurements are extrapolated to it.
    detection : DetectionRates, optional
        Miss and false positive rates; by default none. Missed fruit are assumed to resemble the
        found ones of their row.
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
    hanging = sorted(
        (f for f in fruit if not f.picked),
        key=lambda f: (natural_key(f.row), f.side, f.position_m, f.fruit_id),
    )
    day_of_forecast = max((f.day for f in fruit), default=0.0) if today is None else today
    rng = np.random.default_rng(seed)
    lengths_m, newcomer_m = draw_lengths(
        hanging, growth, day_of_forecast, days, draws, scale_sd, rng, profile.accepted_m[0]
    )
    tally = _Tally(
        fruit=hanging,
        profile=profile,
        lengths_m=lengths_m,
        detection=detection or DetectionRates(),
        rng=rng,
    )
    shape = (len(hanging), days + 1, len(profile.outcomes))
    probability, in_class, picked = np.empty(shape), [], []
    for day in range(days + 1):
        probability[:, day], counts, newly_ready = tally.day(day)
        in_class.append(counts)
        picked.append(newly_ready)
    house, by_row = _counts(np.stack(in_class, axis=2), level, rng)
    picks, row_picks = _counts(np.stack(picked, axis=2), level, rng)
    return Forecast(
        today=day_of_forecast,
        days=np.arange(days + 1),
        classes=profile.outcomes,
        pick=profile.pick,
        rows=tally.rows,
        fruit=tuple(hanging),
        possible=_possible_today(hanging, growth, day_of_forecast, scale_sd, profile),
        probability=probability,
        house=house,
        by_row=by_row,
        picks=picks,
        row_picks=row_picks,
        complete=_complete(newcomer_m, profile),
        level=level,
        growth=growth,
    )


def _possible_today(
    fruit: Sequence[FruitState], growth: Growth, today: float, scale_sd: float, profile: CropProfile
) -> tuple[tuple[str, ...], ...]:
    """Return the classes that each fruit may be in today, independently of all other fruit.

    On the day of its measurement these are the fruit's own classes; later, those that its interval
    spans after growth. A fruit in no class, or possibly in any, stays so.
    """
    names = [c.name for c in profile.classes]
    possible = [state.possible for state in fruit]
    aged = [
        k
        for k, state in enumerate(fruit)
        if not state.possible
        or (
            state.day < today
            and state.possible != (NO_CLASS,)
            and {*state.possible} < {*profile.outcomes}
        )
    ]
    if not aged:
        return tuple(possible)
    mean, sd = lengths_today([fruit[k] for k in aged], growth, today, scale_sd)
    for k, low_m, high_m in zip(aged, mean - INTERVAL_Z * sd, mean + INTERVAL_Z * sd, strict=True):
        state = fruit[k]
        best = names.index(state.best_class) if state.best_class else 0
        bins = [max(n, best) if n < len(names) else n for n in profile.outcome_of_bin]
        by_bin = [profile.outcomes[n] for n in bins]
        ends = float(low_m), math.inf if state.at_least else float(high_m)
        possible[k] = possible_classes(*ends, profile.edges_m, by_bin)
    return tuple(possible)


class _Tally:
    """Counts classes day by day, and remembers which fruit were ready before."""

    def __init__(
        self,
        fruit: Sequence[FruitState],
        profile: CropProfile,
        lengths_m: NDArray[np.float32],
        detection: DetectionRates,
        rng: np.random.Generator,
    ) -> None:
        names = [c.name for c in profile.classes]
        self.rows = tuple(dict.fromkeys(f.row for f in fruit))
        index_of_row = {name: k for k, name in enumerate(self.rows)}
        self._profile, self._lengths_m = profile, lengths_m
        self._edges = profile.edges_m.astype(np.float32)
        self._weights = _weights(lengths_m.shape[1:], detection, rng)
        self._of_bin = np.array(profile.outcome_of_bin, np.int8)
        best = [names.index(f.best_class) if f.best_class else 0 for f in fruit]
        self._best = np.array(best, np.int8)
        self._ready = np.array([name in profile.pick for name in profile.outcomes])
        row = np.array([index_of_row[f.row] for f in fruit], np.int64)
        shape = lengths_m.shape[1:]
        # The fruit of a row are contiguous.
        ends = np.searchsorted(row, np.arange(len(self.rows) + 1)).tolist()
        self._spans = [slice(*span) for span in pairwise(ends)]
        self._before = np.zeros(shape, bool)

    def day(self, day: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return probabilities (N, C), and counts in class and newly ready, (draws, R, C)."""
        lengths = self._lengths_m[day]
        bins = np.zeros(lengths.shape, np.int8)
        for edge in self._edges:
            bins += lengths >= edge
        class_of_bin = self._of_bin.take(bins)
        classes = len(self._profile.classes)
        if self._best.any():
            class_of_bin = np.where(
                class_of_bin < classes, np.maximum(class_of_bin, self._best), class_of_bin
            )
        newly = self._ready.take(class_of_bin) & ~self._before
        self._before |= newly
        is_class = [class_of_bin == k for k in range(classes + 2)]
        share = [
            np.add.reduce(members, axis=0, dtype=np.int32) / len(class_of_bin)
            for members in is_class
        ]
        in_class = [self._count(members) for members in is_class]
        ready = [self._count(members & newly) for members in is_class]
        return np.stack(share, axis=-1), np.stack(in_class, axis=-1), np.stack(ready, axis=-1)

    def _count(self, which: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the weighted number of the chosen fruit, (draws, R)."""
        weighed = which if self._weights is None else which * self._weights
        counts = np.zeros((len(which), len(self._spans)))
        for row, span in enumerate(self._spans):
            counts[:, row] = weighed[:, span].sum(axis=1)
        return counts


def _weights(
    shape: tuple[int, ...], detection: DetectionRates, rng: np.random.Generator
) -> NDArray[np.float32] | None:
    """Draw a weight for each detected fruit, shape (draws, N); None if all weights are 1.

    A false positive has weight 0; a real fruit has weight 1 plus missed ones. If fruit are found
    with probability q, the number of missed fruit per found one is geometric, so the mean weight is
    1 / q.
    """
    if detection == DetectionRates():
        return None
    weights = np.ones(shape, np.float32)
    if detection.found < 1 or detection.found_sd > 0:
        q = rng.normal(detection.found, detection.found_sd, (shape[0], 1)).clip(0.05, 1.0)
        weights *= rng.geometric(np.broadcast_to(q, shape))
    if detection.false > 0:
        weights *= rng.random(shape, np.float32) >= detection.false
    return weights


def _counts(
    drawn: NDArray[np.float64], level: float, rng: np.random.Generator
) -> tuple[Counts, Counts]:
    """Return the house's and the rows' counts of draws, shape (draws, R, D, C)."""
    ends = [0.5 - level / 2, 0.5 + level / 2]
    house_and_rows = []
    for counts in (drawn.sum(axis=1), drawn):
        # Jitter by half a fruit: the whole numbers in the interval then cover `level` on average,
        # where plain quantiles of small counts would cover far more.
        jitter = rng.uniform(-0.5, 0.5, (counts.shape[-2], *counts.shape[:-2], counts.shape[-1]))
        # Today first: it is independent of the number of days.
        low_count, high_count = np.quantile(counts + np.moveaxis(jitter, 0, -2), ends, axis=0)
        mean = counts.mean(axis=0)
        # Whole numbers around the mean.
        low_count = np.minimum(np.ceil(low_count), np.floor(mean))
        high_count = np.maximum(np.floor(high_count), np.ceil(mean))
        house_and_rows.append(Counts(mean, low_count + 0.0, high_count))
    return house_and_rows[0], house_and_rows[1]


def _complete(newcomer_m: NDArray[np.float32], profile: CropProfile) -> NDArray[np.bool_]:
    """Return for each day and class whether no fruit too small today can be in it, (D, C)."""
    entries = [*(c.min_cm / 100 for c in profile.classes), np.inf, profile.edges_m[-1]]
    reach = [(newcomer_m >= entry).mean(axis=1) for entry in entries]
    complete = np.stack(reach, axis=1) <= _SURELY_COMPLETE
    complete[1:, len(profile.classes)] = False  # new fruit join 'too short' every day
    return complete
