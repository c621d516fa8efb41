"""What a round is worth today: how old it is, and what of it is ready to be picked."""

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

from cucumbervision.agronomy.picking import Pick, pick_list
from cucumbervision.agronomy.profiles import TOO_LONG
from cucumbervision.errors import ForecastError
from cucumbervision.rounds.forecasting import forecast_for
from cucumbervision.rounds.from_store import read_round
from cucumbervision.rounds.merge_and_link import DAY_S

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.rounds.from_store import RoundContent
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import RoundView

_FRESH_DAYS, _USEFUL_DAYS = 2, 7


class Age(StrEnum):
    """What a round is worth by its age."""

    FRESH = "fresh"  # its lengths are those of today, or nearly so
    OLD = "old"  # aged by the growth that is expected
    USELESS = "useless"  # what hung then is picked, or far too long


@dataclass(frozen=True)
class RowPicks:
    """What is to be picked in one row, in walking order.

    Parameters
    ----------
    row : str
        The row.
    ready, too_long : tuple of Pick
        Fruit of a class that is picked, and those that have outgrown every class.
    """

    row: str
    ready: tuple[Pick, ...]
    too_long: tuple[Pick, ...]


@dataclass(frozen=True, eq=False)
class Today:
    """A round today.

    Parameters
    ----------
    age_days : int
        Days of the calendar since it was walked.
    age : Age
        What it is worth by that.
    forecast : Forecast, optional
        Of today alone; None where the round is too old, or holds nothing to forecast.
    rows : tuple of RowPicks
        What is to be picked, in the order of the walk; fruit picked today are still in it.
    best : mapping of str to str
        The representative view of each fruit, by the keys of all views.
    simulated : frozenset of str
        Views of simulated captures.
    """

    age_days: int
    age: Age
    forecast: Forecast | None
    rows: tuple[RowPicks, ...]
    best: Mapping[str, str]
    simulated: frozenset[str] = frozenset()

    @property
    def ready(self) -> tuple[Pick, ...]:
        """All fruit that are ready."""
        return tuple(pick for row in self.rows for pick in row.ready)

    @property
    def too_long(self) -> tuple[Pick, ...]:
        """All fruit that are too long."""
        return tuple(pick for row in self.rows for pick in row.too_long)

    def left(self, picked: set[str]) -> Today:
        """Return the same without the fruit that were picked meanwhile, by their keys."""

        def still(picks: tuple[Pick, ...]) -> tuple[Pick, ...]:
            return tuple(pick for pick in picks if pick.fruit.fruit_id not in picked)

        rows = [RowPicks(row.row, still(row.ready), still(row.too_long)) for row in self.rows]
        return replace(self, rows=tuple(row for row in rows if row.ready or row.too_long))

    def by_class(self) -> dict[str, dict[str, int]]:
        """Return how many fruit are ready, by row and class; a class that no row has is left out.

        Too long ones are a class of their own.
        """
        found: dict[str, dict[str, int]] = {}
        for row in self.rows:
            own = found.setdefault(row.row, {})
            for pick in (*row.ready, *row.too_long):
                own[pick.name] = own.get(pick.name, 0) + 1
        return found


def midnight_s(now_s: float) -> float:
    """Return when the day of a moment began here, seconds since 1970."""
    here = datetime.datetime.fromtimestamp(now_s).astimezone()
    return here.replace(hour=0, minute=0, second=0, microsecond=0).timestamp()


def age_of(walked_s: float, now_s: float) -> tuple[int, Age]:
    """Return a round's age in days of the calendar, and what it is worth.

    Examples
    --------
    >>> age_of(1_700_000_000.0, 1_700_000_000.0 + 3 * DAY_S)
    (3, <Age.OLD: 'old'>)
    """
    days = round((midnight_s(now_s) - midnight_s(walked_s)) / DAY_S)
    if days > _USEFUL_DAYS:
        return days, Age.USELESS
    return days, Age.OLD if days > _FRESH_DAYS else Age.FRESH


def age_words(days: int) -> str:
    """Return an age as people say it.

    Examples
    --------
    >>> age_words(0), age_words(1), age_words(4), age_words(400)
    ('of today', 'of yesterday', '4 days old', '1 year old')
    """
    if days < 2:
        return "of yesterday" if days == 1 else "of today"
    if days < 60:
        return f"{days} days old"
    many, what = (days // 365, "year") if days >= 365 else (days // 30, "month")
    return f"{many} {what}{'' if many == 1 else 's'} old"


def forecast_today(
    store: Store,
    one: RoundView,
    profile: CropProfile,
    now_s: float,
    content: RoundContent | None = None,
    *,
    days: int = 7,
    picked_before_s: float = math.inf,
) -> Forecast:
    """Forecast a round from today on, for all pages, files and commands.

    Of a round that is too old to say anything of today, day 0 is the day of its walk.

    Parameters
    ----------
    store, one, profile, now_s, content
        As `read_today` takes them.
    days, picked_before_s
        As `forecast_for` takes them.

    Raises
    ------
    ForecastError
        If nothing can be forecast.
    """
    return forecast_for(
        store,
        one.key,
        profile,
        days,
        content,
        today_s=day_0_s(one, now_s),
        picked_before_s=picked_before_s,
    )


def day_0_s(one: RoundView, now_s: float) -> float:
    """Return day 0 of a round's forecast, seconds since 1970: today unless it is too old."""
    days, age = age_of(one.last_s or one.record.started_s, now_s)
    return one.record.started_s + (0 if age is Age.USELESS else max(days, 0)) * DAY_S


def read_today(
    store: Store,
    one: RoundView,
    profile: CropProfile,
    now_s: float,
    content: RoundContent | None = None,
) -> Today:
    """Return what a round says of today.

    Parameters
    ----------
    store : Store
        Where it is.
    one : RoundView
        The round.
    profile : CropProfile
        Its classes, and the growth that is expected.
    now_s : float
        Now, seconds since 1970.
    content : RoundContent, optional
        What `from_store.read_round` gave of the round, where it was read already.
    """
    days, age = age_of(one.last_s or one.record.started_s, now_s)
    content = content or read_round(store, one.key)
    best = {view.key: view.group for view in content.views}
    if age is Age.USELESS:
        return Today(days, age, None, (), best)
    try:
        found = forecast_today(
            store, one, profile, now_s, content, days=0, picked_before_s=midnight_s(now_s)
        )
    except ForecastError:
        return Today(days, age, None, (), best)
    simulated = frozenset(view.key for view in content.views if view.simulated)
    return Today(days, age, found, _by_row(pick_list(found)), best, simulated)


def _by_row(picks: Sequence[Pick]) -> tuple[RowPicks, ...]:
    rows = dict.fromkeys(pick.fruit.row for pick in picks)
    return tuple(
        RowPicks(
            row,
            tuple(p for p in picks if p.fruit.row == row and p.name != TOO_LONG),
            tuple(p for p in picks if p.fruit.row == row and p.name == TOO_LONG),
        )
        for row in rows
    )
