"""What to pick today, in walking order, and the hours and crates that each day's picking takes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.agronomy.fruit import natural_key
from cucumbervision.agronomy.profiles import TOO_LONG
from cucumbervision.errors import ForecastError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.agronomy.fruit import FruitState

__all__ = ["DayWork", "Pick", "Rates", "Span", "pick_list", "plan_work"]


@dataclass(frozen=True)
class Pick:
    """One fruit of the pick list.

    Parameters
    ----------
    fruit : FruitState
        Row, side, position and length.
    name : str
        Its likeliest class today, or 'too long': to be taken off before it costs others growth.
    ready : float
        Probability to be in a class that is picked.
    """

    fruit: FruitState
    name: str
    ready: float


def pick_list(
    forecast: Forecast, threshold: float = 0.5, *, back_and_forth: bool = True
) -> tuple[Pick, ...]:
    """Return today's ready fruit by row and position.

    Parameters
    ----------
    forecast : Forecast
        Whose day 0 is today; fruit marked picked are not in it.
    threshold : float
        Fruit at least this probable to be ready, or to be too long, are listed.
    back_and_forth : bool
        Walk every second row from its far end, so that no way is walked twice. A row's sides are
        walked together, as fruit of both hang along one path.

    Raises
    ------
    ForecastError
        If the threshold is no probability.

    Examples
    --------
    >>> from cucumbervision.agronomy.forecast import FruitState, forecast
    >>> from cucumbervision.agronomy.growth import GrowthPrior, fit_growth
    >>> from cucumbervision.agronomy.profiles import load_profile
    >>> profile = load_profile("long-cucumber")
    >>> at = [("2", 4.0, 0.28), ("2", 9.0, 0.30), ("1", 3.0, 0.27), ("1", 5.0, 0.22)]
    >>> fruit = [FruitState(f"{row}-{x}", row, x, length, 0.004) for row, x, length in at]
    >>> found = forecast(fruit, fit_growth([], GrowthPrior.of(profile)), profile)
    >>> [(pick.fruit.row, pick.fruit.position_m, pick.name) for pick in pick_list(found)]
    [('1', 3.0, 'I'), ('2', 9.0, 'I'), ('2', 4.0, 'I')]
    """
    if not 0 < threshold <= 1:
        raise ForecastError(
            f"the threshold is {threshold}", remedy="give a probability above 0, at most 1"
        )
    too_long = forecast.classes.index(TOO_LONG)
    listed = []
    for one, ready, chances in zip(
        forecast.fruit, forecast.ready, forecast.probability[:, 0], strict=True
    ):
        if max(ready, chances[too_long]) >= threshold:
            listed.append(Pick(one, forecast.classes[int(chances.argmax())], float(ready)))
    rows = sorted({pick.fruit.row for pick in listed}, key=natural_key)
    ways = {row: -1 if back_and_forth and k % 2 else 1 for k, row in enumerate(rows)}
    return tuple(
        sorted(
            listed,
            key=lambda pick: (
                natural_key(pick.fruit.row),
                ways[pick.fruit.row] * pick.fruit.position_m,
                pick.fruit.side,
                pick.fruit.fruit_id,
            ),
        )
    )


@dataclass(frozen=True)
class Rates:
    """How fast people pick, and what a crate holds. The defaults are examples, not measured.

    Parameters
    ----------
    fruit_per_hour : float
        Fruit that one person picks in an hour.
    minutes_per_row : float
        Walking and turning for each row that has fruit to pick.
    fruit_per_crate : int
        Fruit in a crate.
    fruit_per_crate_of : dict of str to int
        The same for classes that are packed otherwise.

    Raises
    ------
    ForecastError
        If a rate is not positive and finite.
    """

    fruit_per_hour: float = 350.0
    minutes_per_row: float = 2.0
    fruit_per_crate: int = 12
    fruit_per_crate_of: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        crates = {"fruit_per_crate": self.fruit_per_crate}
        crates |= {f"fruit_per_crate of {k}": n for k, n in self.fruit_per_crate_of.items()}
        if not (np.isfinite(self.fruit_per_hour) and self.fruit_per_hour > 0):
            raise ForecastError(
                f"fruit_per_hour is {self.fruit_per_hour}", remedy="give a number above 0"
            )
        if not (np.isfinite(self.minutes_per_row) and self.minutes_per_row >= 0):
            raise ForecastError(
                f"minutes_per_row is {self.minutes_per_row}", remedy="give 0 or more minutes"
            )
        for name, number in crates.items():
            if number != int(number) or number < 1:
                raise ForecastError(f"{name} is {number}", remedy="give a whole number from 1 on")


@dataclass(frozen=True)
class Span:
    """A figure: what is expected, and its interval."""

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
        Fruit to pick, and hours of work for one person.
    crates : dict of str to Span
        Crates by class, whole ones.
    complete : bool
        Whether fruit too small to be measured today can add nothing.
    """

    day: int
    fruit: Span
    hours: Span
    crates: dict[str, Span]
    complete: bool


def plan_work(forecast: Forecast, rates: Rates | None = None) -> tuple[DayWork, ...]:
    """Turn a forecast into hours and crates.

    Parameters
    ----------
    forecast : Forecast
        Its picks.
    rates : Rates, optional
        The user's own.

    Raises
    ------
    ForecastError
        If the rates name a class that the profile has not.

    Notes
    -----
    The ends of the intervals are those of the counts, class by class; where several classes are
    picked, their sum holds at least the level.

    Examples
    --------
    >>> from cucumbervision.agronomy.forecast import FruitState, forecast
    >>> from cucumbervision.agronomy.growth import GrowthPrior, fit_growth
    >>> from cucumbervision.agronomy.profiles import load_profile
    >>> profile = load_profile("long-cucumber")
    >>> fruit = [FruitState(str(k), "1", 0.1 * k, 0.30, 0.004) for k in range(70)]
    >>> found = forecast(fruit, fit_growth([], GrowthPrior.of(profile)), profile)
    >>> today = plan_work(found, Rates(fruit_per_hour=350, minutes_per_row=3))[0]
    >>> today.fruit.expected, today.hours.expected, today.crates["I"].expected
    (70.0, 0.25, 6.0)
    """
    rates = rates or Rates()
    if unknown := set(rates.fruit_per_crate_of) - set(forecast.classes):
        raise ForecastError(
            f"no class is called {min(unknown)!r}", remedy=f"take of {', '.join(forecast.classes)}"
        )
    chosen = [forecast.classes.index(name) for name in forecast.pick]
    plans = []
    for day in forecast.days.tolist():
        counts = [getattr(forecast.picks, end)[day, chosen] for end in ("expected", "low", "high")]
        rows = forecast.row_picks.expected[:, day][:, chosen].sum(axis=1)
        # A row with half a fruit expected is walked about half of the time.
        walking = rates.minutes_per_row / 60 * float(np.minimum(rows, 1.0).sum())
        fruit = [float(number.sum()) for number in counts]
        hours = [number / rates.fruit_per_hour + walking for number in fruit]
        crates = {
            name: Span(
                *_crates(counts, k, rates.fruit_per_crate_of.get(name, rates.fruit_per_crate))
            )
            for k, name in enumerate(forecast.pick)
        }
        complete = bool(forecast.complete[day, chosen].all())
        plans.append(DayWork(day, Span(*fruit), Span(*hours), crates, complete))
    return tuple(plans)


def _crates(counts: list[NDArray[np.float64]], k: int, holds: int) -> list[float]:
    return [float(np.ceil(number[k] / holds - 1e-9)) for number in counts]
