"""Today's pick list in walking order, and hours and crates for each day's picking."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.crop.grades import class_of
from cucumbervision.crop.profiles import TOO_LONG
from cucumbervision_greenhouse.forecast.forecast import natural_key

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from cucumbervision_greenhouse.forecast.forecast import Forecast
    from cucumbervision_greenhouse.forecast.length_draws import FruitState


class PickKind(StrEnum):
    """Why a fruit is on the pick list; stable codes for tables."""

    READY = "ready"
    UNDECIDED = "may be ready"
    TOO_LONG = "too long"


@dataclass(frozen=True)
class Pick:
    """One fruit of the pick list.

    Parameters
    ----------
    fruit : FruitState
        Row, side, position and length.
    name : str
        Its class, 'too long' (remove it so that others grow), or 'undecided'.
    ready : float
        Probability of a class that is picked.
    kind : PickKind
        Whether it is ready, may be, or is too long.
    possible : tuple of str
        The classes that it may be in.
    """

    fruit: FruitState
    name: str
    ready: float
    kind: PickKind = PickKind.READY
    possible: tuple[str, ...] = ()


def pick_list(forecast: Forecast) -> tuple[Pick, ...]:
    """Return the fruit that are ready, may be ready or are too long, by row and position.

    Every second row is walked from its far end, to avoid walking a row twice. Both sides of a row
    are walked together, since they share one path.

    Parameters
    ----------
    forecast : Forecast
        Its day 0 is today; picked fruit are excluded.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.forecast import forecast
    >>> from cucumbervision_greenhouse.forecast.length_draws import FruitState
    >>> from cucumbervision_greenhouse.forecast.growth import GrowthPrior, fit_growth
    >>> from cucumbervision.crop.profiles import load_profile
    >>> profile = load_profile("long-cucumber")
    >>> places = [("2", 4.0, 0.28), ("2", 9.0, 0.25), ("1", 3.0, 0.27), ("1", 5.0, 0.22)]
    >>> fruit = [FruitState(f"{row}-{x}", row, x, length, 0.004) for row, x, length in places]
    >>> today = forecast(fruit, fit_growth([], GrowthPrior.of(profile)), profile)
    >>> [(pick.fruit.row, pick.fruit.position_m, pick.name) for pick in pick_list(today)]
    [('1', 3.0, 'I'), ('2', 9.0, 'undecided'), ('2', 4.0, 'I')]
    """
    kinds = [_kind(possible, forecast.pick) for possible in forecast.possible]
    listed = [
        Pick(fruit=state, name=class_of(possible), ready=float(ready), kind=kind, possible=possible)
        for state, possible, ready, kind in zip(
            forecast.fruit, forecast.possible, forecast.ready, kinds, strict=True
        )
        if kind is not None
    ]
    rows = sorted({pick.fruit.row for pick in listed}, key=natural_key)
    index_of = {row: index for index, row in enumerate(rows)}

    def along_the_walk(pick: Pick) -> tuple[int, float, str, str]:
        row_index = index_of[pick.fruit.row]
        position = -pick.fruit.position_m if row_index % 2 else pick.fruit.position_m
        return row_index, position, pick.fruit.side, pick.fruit.fruit_id

    return tuple(sorted(listed, key=along_the_walk))


def _kind(possible: tuple[str, ...], picked: Sequence[str]) -> PickKind | None:
    if {*possible} <= {*picked}:
        return PickKind.READY
    if possible == (TOO_LONG,):
        return PickKind.TOO_LONG
    return PickKind.UNDECIDED if {*possible} & {*picked} else None


@dataclass(frozen=True)
class Rates:
    """Picking rates and crate size. The defaults are examples, not measurements.

    Parameters
    ----------
    fruit_per_hour : float
        Fruit per person and hour.
    minutes_per_row : float
        Walking and turning time per row with fruit to pick.
    fruit_per_crate : int
        Fruit in a crate.
    """

    fruit_per_hour: float = 350.0
    minutes_per_row: float = 2.0
    fruit_per_crate: int = 12


@dataclass(frozen=True)
class Span:
    """An expected value with its interval."""

    expected: float
    low: float
    high: float


@dataclass(frozen=True)
class DayWork:
    """One day's picking, if every ready fruit is picked every day.

    Parameters
    ----------
    day : int
        Days from today.
    fruit, hours : Span
        Fruit to pick, and hours for one person.
    crates : dict of str to Span
        Whole crates by class.
    complete : bool
        Whether fruit that are too small to be measured today cannot add to it.
    """

    day: int
    fruit: Span
    hours: Span
    crates: dict[str, Span]
    complete: bool


@dataclass(frozen=True)
class PickWork:
    """The ready fruit of a pick list, and the work of picking them.

    Parameters
    ----------
    fruit : int
        Fruit of classes that are picked.
    by_class : dict of str to int
        Fruit by class.
    hours : float
        For one person.
    crates : dict of str to int
        Whole crates by class.
    """

    fruit: int
    by_class: dict[str, int]
    hours: float
    crates: dict[str, int]


def work_of(picks: Iterable[Pick], rates: Rates | None = None) -> PickWork:
    """Return the fruit of a pick list that are ready, and the work of picking them.

    Parameters
    ----------
    picks : iterable of Pick
        Fruit still to be picked.
    rates : Rates, optional
        The user's own.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.length_draws import FruitState
    >>> picks = [Pick(FruitState(str(k), "1", 0.1 * k, 0.3, 0.004), "I", 1.0) for k in range(70)]
    >>> work = work_of(picks, Rates(fruit_per_hour=350, minutes_per_row=3))
    >>> work.fruit, work.hours, work.crates
    (70, 0.25, {'I': 6})
    """
    rates = rates or Rates()
    ready = [pick for pick in picks if pick.kind is PickKind.READY]
    by_class = Counter(pick.name for pick in ready)
    walking = rates.minutes_per_row / 60 * len({pick.fruit.row for pick in ready})
    hours = len(ready) / rates.fruit_per_hour + walking
    crates = {name: math.ceil(n / rates.fruit_per_crate) for name, n in by_class.items()}
    return PickWork(len(ready), dict(by_class), hours, crates)


def hours_words(hours: float) -> str:
    """Format hours of work; less than 1.5 hours as minutes.

    Examples
    --------
    >>> hours_words(0.31), hours_words(3.24)
    ('19 min', '3.2 h')
    """
    return f"{hours:.1f} h" if hours >= 1.5 else f"{math.ceil(60 * hours - 1e-9):d} min"


def plan_work(forecast: Forecast, rates: Rates | None = None) -> tuple[DayWork, ...]:
    """Turn a forecast into hours and crates.

    Parameters
    ----------
    forecast : Forecast
        Its picks.
    rates : Rates, optional
        The user's own.

    Notes
    -----
    The intervals are those of the counts by class; if several classes are picked, the interval of
    their sum covers at least the level. Today's count is that of the pick list (`work_of`), so that
    every page shows the same number; its interval allows for missed fruit and false positives.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.forecast import forecast
    >>> from cucumbervision_greenhouse.forecast.length_draws import FruitState
    >>> from cucumbervision_greenhouse.forecast.growth import GrowthPrior, fit_growth
    >>> from cucumbervision.crop.profiles import load_profile
    >>> profile = load_profile("long-cucumber")
    >>> fruit = [FruitState(str(k), "1", 0.1 * k, 0.30, 0.004) for k in range(70)]
    >>> week = forecast(fruit, fit_growth([], GrowthPrior.of(profile)), profile)
    >>> today = plan_work(week, Rates(fruit_per_hour=350, minutes_per_row=3))[0]
    >>> today.fruit.expected, today.hours.expected, today.crates["I"].expected
    (70.0, 0.25, 6.0)
    """
    rates = rates or Rates()
    chosen = [forecast.classes.index(name) for name in forecast.pick]
    today, plans = work_of(pick_list(forecast), rates), []
    for day in forecast.days.tolist():
        counts = [getattr(forecast.picks, end)[day, chosen] for end in ("expected", "low", "high")]
        if day == 0:
            listed = np.array([today.by_class.get(name, 0) for name in forecast.pick], np.float64)
            counts = [listed, np.minimum(counts[1], listed), np.maximum(counts[2], listed)]
        rows = forecast.row_picks.expected[:, day][:, chosen].sum(axis=1)
        # A row with 0.5 expected fruit is walked about half of the time.
        walking = rates.minutes_per_row / 60 * float(np.minimum(rows, 1.0).sum())
        fruit = [float(number.sum()) for number in counts]
        if day == 0:
            walking = today.hours - today.fruit / rates.fruit_per_hour
        hours = [number / rates.fruit_per_hour + walking for number in fruit]
        crates = {
            name: Span(*(float(math.ceil(n[k] / rates.fruit_per_crate - 1e-9)) for n in counts))
            for k, name in enumerate(forecast.pick)
        }
        complete = bool(forecast.complete[day, chosen].all())
        plans.append(
            DayWork(
                day=day, fruit=Span(*fruit), hours=Span(*hours), crates=crates, complete=complete
            )
        )
    return tuple(plans)
