"""Today's pick list in walking order, and hours and crates for each day's picking."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from cucumbervision.crop.grades import class_of
from cucumbervision.crop.profiles import TOO_LONG
from cucumbervision_greenhouse.forecast.forecast import Forecast, natural_key
from cucumbervision_greenhouse.forecast.growth import FruitState

_SURE = 0.95  # probability from which a fruit is surely ready on a later day


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
    length_m : float
        Expected length today, metres.
    """

    fruit: FruitState
    name: str
    ready: float
    kind: PickKind = PickKind.READY
    possible: tuple[str, ...] = ()
    length_m: float = 0.0


def pick_list(forecast: Forecast) -> tuple[Pick, ...]:
    """Return the fruit that are ready, may be ready or are too long, by row and position.

    Every second row is walked from its far end, to avoid walking a row twice. Both sides of a row
    are walked together, since they share one path.

    Parameters
    ----------
    forecast : Forecast
        Its day 0 is today; picked fruit are listed too.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.forecast import forecast
    >>> from cucumbervision_greenhouse.forecast.growth import FruitState
    >>> from cucumbervision_greenhouse.forecast.growth import GrowthPrior, fit_growth
    >>> from cucumbervision.crop.profiles import load_profile
    >>> profile = load_profile("long-cucumber")
    >>> places = [("2", 4.0, 0.28), ("2", 9.0, 0.25), ("1", 3.0, 0.27), ("1", 5.0, 0.22)]
    >>> fruit = [FruitState(f"{row}-{x}", row, x, length, 0.004) for row, x, length in places]
    >>> today = forecast(fruit, fit_growth([], GrowthPrior.of(profile)), profile)
    >>> [(pick.fruit.row, pick.fruit.position_m, pick.name) for pick in pick_list(today)]
    [('1', 3.0, 'I'), ('2', 9.0, 'undecided'), ('2', 4.0, 'I')]
    """
    columns = forecast.fruit, forecast.possible, forecast.length_m, forecast.ready()
    listed = [
        Pick(state, class_of(possible), float(ready), kind, possible, float(length_m))
        for (state, possible, length_m, ready), kind in zip(
            zip(*columns, strict=True), _kinds(forecast), strict=True
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


def _kinds(forecast: Forecast, day: int = 0) -> list[PickKind | None]:
    """Return which fruit are surely ready, may be, or are too long: today by their classes."""
    if day == 0:
        return [_kind({*possible}, {*forecast.pick}) for possible in forecast.possible]
    ready = forecast.ready(day)
    kinds = {True: PickKind.READY, False: PickKind.UNDECIDED}
    return [kinds[share >= _SURE] if share >= 1 - _SURE else None for share in ready.tolist()]


def _kind(possible: set[str], picked: set[str]) -> PickKind | None:
    if possible <= picked:
        return PickKind.READY
    if possible == {TOO_LONG}:
        return PickKind.TOO_LONG
    return PickKind.UNDECIDED if possible & picked else None


@dataclass(frozen=True)
class Ready:
    """The fruit that are ready on a day, if none is picked before.

    Parameters
    ----------
    expected : dict of str to float
        The sum of the fruit's probabilities, by class that is picked.
    sure, may_be, too_long : int
        Fruit that are surely ready, those that may be, and too long ones; a day later than today
        counts no too long ones.
    """

    expected: dict[str, float]
    sure: int
    may_be: int
    too_long: int

    @property
    def fruit(self) -> float:
        """The expected number of all classes."""
        return sum(self.expected.values())


def ready_on(
    forecast: Forecast, day: int = 0, row: str | None = None, picked: Collection[str] = ()
) -> Ready:
    """Return the fruit that are ready on a day: the one definition for all pages and files.

    Parameters
    ----------
    forecast : Forecast
        Of a round.
    day : int
        Days from today.
    row : str, optional
        One row alone.
    picked : collection of str
        Keys of fruit that were picked since the forecast was made.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.forecast import forecast
    >>> from cucumbervision_greenhouse.forecast.growth import FruitState, GrowthPrior, fit_growth
    >>> from cucumbervision.crop.profiles import load_profile
    >>> profile = load_profile("long-cucumber")
    >>> lengths = [0.22, 0.24, 0.25, 0.28]
    >>> fruit = [FruitState(str(x), "1", 0.0, x, 0.01) for x in lengths]
    >>> today = ready_on(forecast(fruit, fit_growth([], GrowthPrior.of(profile)), profile))
    >>> round(today.fruit), today.sure, today.may_be
    (2, 1, 2)
    """
    counted = np.array(
        [
            not f.picked and f.fruit_id not in picked and row in (None, f.row)
            for f in forecast.fruit
        ],
        bool,
    )
    sums = forecast.probability[counted, day].sum(axis=0)
    kinds = Counter(k for k, counts in zip(_kinds(forecast, day), counted, strict=True) if counts)
    return Ready(
        {name: float(sums[forecast.classes.index(name)]) for name in forecast.pick},
        *(kinds[kind] for kind in PickKind),
    )


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


def work(
    by_class: Mapping[str, float], rows: Iterable[float], rates: Rates
) -> tuple[float, dict[str, float]]:
    """Return hours for one person and whole crates by class.

    Parameters
    ----------
    by_class : mapping of str to float
        Fruit to pick.
    rows : iterable of float
        Fruit to pick in each row; one with 0.5 expected fruit is walked half of the time.
    rates : Rates
        The user's own.

    Examples
    --------
    >>> work({"I": 70.0}, [70.0, 0.0], Rates(fruit_per_hour=350, minutes_per_row=3))
    (0.25, {'I': 6.0})
    """
    walking = rates.minutes_per_row / 60 * sum(min(fruit, 1.0) for fruit in rows)
    crates = {
        name: float(math.ceil(fruit / rates.fruit_per_crate - 1e-9))
        for name, fruit in by_class.items()
    }
    return sum(by_class.values()) / rates.fruit_per_hour + walking, crates


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
    their sum covers at least the level.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.forecast import forecast
    >>> from cucumbervision_greenhouse.forecast.growth import FruitState, GrowthPrior, fit_growth
    >>> from cucumbervision.crop.profiles import load_profile
    >>> profile = load_profile("long-cucumber")
    >>> fruit = [FruitState(str(k), "1", 0.1 * k, 0.30, 0.004) for k in range(70)]
    >>> week = forecast(fruit, fit_growth([], GrowthPrior.of(profile)), profile)
    >>> today = plan_work(week, Rates(fruit_per_hour=350, minutes_per_row=3))[0]
    >>> today.fruit.expected, today.hours.expected, today.crates["I"].expected
    (70.0, 0.25, 6.0)
    """
    chosen = [forecast.classes.index(name) for name in forecast.pick]
    plans = []
    for day in forecast.days.tolist():
        rows = forecast.row_picks.expected[:, day][:, chosen].sum(axis=1).tolist()
        ends = [
            dict(zip(forecast.pick, counts[day, chosen].tolist(), strict=True))
            for counts in vars(forecast.picks).values()
        ]
        hours, crates = zip(
            *(work(by_class, rows, rates or Rates()) for by_class in ends), strict=True
        )
        plans.append(
            DayWork(
                day=day,
                fruit=Span(*(sum(by_class.values()) for by_class in ends)),
                hours=Span(*hours),
                crates={name: Span(*(end[name] for end in crates)) for name in forecast.pick},
                complete=bool(forecast.complete[day, chosen].all()),
            )
        )
    return tuple(plans)
