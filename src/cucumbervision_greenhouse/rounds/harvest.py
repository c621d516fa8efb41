"""Harvests: what was picked by day and row, and how far forecasts were from it."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta
from functools import lru_cache
from statistics import fmean
from typing import Annotated, Any, TypeAlias

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from cucumbervision.crop.grades import grade
from cucumbervision.crop.profiles import CropProfile
from cucumbervision.errors import RoundError
from cucumbervision.files import parse_model
from cucumbervision_greenhouse.forecast.picking import Span
from cucumbervision_greenhouse.rounds.forecasting import forecast_today, midnight_s
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table, read_round
from cucumbervision_greenhouse.rounds.merge_and_link import rounds_of_house
from cucumbervision_greenhouse.rounds.walking import csv_lines
from cucumbervision_greenhouse.store.records import FruitRow, Round
from cucumbervision_greenhouse.store.repository import Store

DAYS_AHEAD = 1, 3, 7
HEAD = "day;row;class;fruit;crates;kg"
_NEWEST = 7  # rounds whose forecasts are compared


Picked: TypeAlias = "dict[date, tuple[float, float | None]]"
"""Fruit that were picked by day, and kg where they are known."""


def _iso(cell: Any) -> Any:
    """Return a day such as 28-11-2026 as 2026-11-28."""
    return re.sub(r"^(\d\d)[-/.](\d\d)[-/.](\d{4})$", r"\3-\2-\1", str(cell))


_Amount = Annotated[
    float, BeforeValidator(lambda cell: str(cell).replace(",", ".")), Field(ge=0, le=1e6)
]


class HarvestLine(BaseModel):
    """What was picked on a day, in a row or the whole house, of a class or all."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    day: Annotated[date, BeforeValidator(_iso)]
    row: str = ""
    class_: str = Field("", alias="class")
    fruit: _Amount | None = None
    crates: _Amount = 0.0
    kg: _Amount | None = None


def read_harvest(text: str, fruit_per_crate: int) -> tuple[list[HarvestLine], list[str]]:
    r"""Read a table of picked fruit, as typed or copied from a CSV file or a spreadsheet.

    Parameters
    ----------
    text : str
        A line of names, those of `HarvestLine`, and further lines, split by semicolons, tabs or
        commas. Decimal commas need semicolons or tabs.
    fruit_per_crate : int
        Fruit in a crate, for lines that give crates and not fruit.

    Returns
    -------
    lines : list of HarvestLine
        All with their fruit.
    unknown : list of str
        Columns that are not known.

    Raises
    ------
    RoundError
        If a line cannot be read.

    Examples
    --------
    >>> [line], unknown = read_harvest("day;row;crates;kg;by\n28-11-2026;3;2;8,4;Ana", 12)
    >>> line.day.isoformat(), line.row, line.fruit, line.kg, unknown
    ('2026-11-28', '3', 24.0, 8.4, ['by'])
    """
    lines, unknown = [], dict[str, None]()
    for number, named in enumerate(csv_lines(text), 2):
        cells = {str(name).strip().lower(): cell for name, cell in named.items()}
        if None in named or cells.keys().isdisjoint(("fruit", "crates")):
            raise RoundError(
                "line {line} needs fruit or crates, and no more cells than the first line",
                remedy="use semicolons where numbers have decimal commas",
                line=number,
            )
        line = parse_model(HarvestLine, cells, source=f"line {number}", error=RoundError)
        fruit = line.crates * fruit_per_crate if line.fruit is None else line.fruit
        lines.append(line.model_copy(update={"fruit": fruit}))
        unknown |= dict.fromkeys(cells.keys() - {*HEAD.split(";")})
    return lines, list(unknown)


def keep_harvest(
    store: Store, round_key: str, lines: Sequence[HarvestLine], today: date
) -> int | None:
    """Keep a harvest of a round's house; return the number of its mark, by which it is undone.

    A line replaces an earlier one of the same day, row and class.

    Raises
    ------
    RoundError
        If there is none, a day is outside the rounds of the house, or more fruit were picked than
        were seen.
    """
    if not lines:
        raise RoundError("no picked fruit were entered", remedy="enter how many were picked")
    walks = rounds_of_house(store, round_key)
    table_of = lru_cache(lambda key: fruit_table(read_round(store, key)))  # once a round
    picked: dict[tuple[date, str], float] = defaultdict(float)
    for line in lines:
        picked[line.day, line.row] += line.fruit or 0
    for (day, row), count in picked.items():
        walk = next((x for x in walks if walked_on(x) <= day <= today), None)
        if walk is None:
            raise RoundError(
                "{day} is not between the first round of this house and today",
                remedy="correct the day",
                day=day.isoformat(),
            )
        if count > (seen := sum(row in ("", x.row) for x in table_of(walk.key))):
            raise RoundError(
                "{count:.0f} fruit were picked on {day}, and the round before saw {seen}",
                remedy="correct the number, or leave out rows that were not walked",
                **{"count": count, "day": day.isoformat(), "seen": seen},
            )
    return store.keep_harvest(round_key, [x.model_dump(mode="json", by_alias=True) for x in lines])


def walked_on(walk: Round) -> date:
    """Return the local day on which a round was walked."""
    return date.fromtimestamp(walk.walked_s)


def harvests(store: Store, walks: Sequence[Round]) -> Picked:
    """Return how many fruit of a house were picked on each day, and kg where they are known.

    On days without a harvest that somebody entered, these are the fruit that were ticked.
    """
    picked: Picked = {}
    keys = {walk.key for walk in walks}
    for walk in walks[:_NEWEST]:
        for fruit in fruit_table(read_round(store, walk.key)):
            if fruit.picked_s is not None:
                day = date.fromtimestamp(fruit.picked_s)
                picked[day] = picked.get(day, (0.0, None))[0] + 1, None
    entered: dict[tuple[date, str, str], HarvestLine] = {}
    for mark in reversed(store.log(kind="harvest", limit=None)):
        if mark.round_key in keys and not mark.undone:
            lines = map(HarvestLine.model_validate, mark.details["lines"])
            entered |= {(line.day, line.row, line.class_): line for line in lines}
    for day in {line.day for line in entered.values()}:
        of_day = [line for line in entered.values() if line.day == day]
        kg = [line.kg for line in of_day if line.kg is not None]
        picked[day] = sum(line.fruit or 0 for line in of_day), sum(kg) if kg else None
    return picked


@dataclass(frozen=True)
class Compared:
    """Forecasts of the fruit picked within some days, the day of the walk included.

    Parameters
    ----------
    days, rounds : int
        How many days, and how many rounds whose forecasts are compared.
    forecast, harvest : float
        Fruit, of all of these rounds.
    error, within : float
        Sum of the differences as a share of the harvest; share of the rounds whose harvest lies in
        the forecast's 80 % interval.
    """

    days: int
    rounds: int
    forecast: float
    harvest: float
    error: float
    within: float


def compare_harvests(
    store: Store, walks: Sequence[Round], profile: CropProfile, picked: Picked, today: date
) -> list[Compared]:
    """Compare what the newest rounds of a house forecast with what was picked since."""
    pairs: dict[int, list[tuple[Span, float]]] = {days: [] for days in DAYS_AHEAD}
    for walk in [x for x in walks if walked_on(x) < today][: _NEWEST if picked else 0]:
        spans = _forecast_picks(store, walk, profile)
        for days in DAYS_AHEAD:
            window = [walked_on(walk) + timedelta(n) for n in range(days)]
            counts = [picked[day][0] for day in window if day in picked]
            if counts and window[-1] < today:
                pairs[days].append((spans[days - 1], sum(counts)))
    compared = []
    for days, of_days in pairs.items():
        if of_days:
            harvest = sum(count for _, count in of_days)
            missed = sum(abs(span.expected - count) for span, count in of_days)
            forecast = sum(span.expected for span, _ in of_days)
            within = fmean(span.low <= count <= span.high for span, count in of_days)
            error = missed / max(harvest, 1.0)
            compared.append(Compared(days, len(of_days), forecast, harvest, error, within))
    return compared


def _forecast_picks(store: Store, walk: Round, profile: CropProfile) -> list[Span]:
    """Return the picks within 1, 2, … days as forecast on a round's day, before any was picked."""
    content, midnight = read_round(store, walk.key), midnight_s(walk.walked_s)
    views = [x.with_(picked_s=None) if (x.picked_s or 0) >= midnight else x for x in content.views]
    content = replace(content, views=tuple(views))
    made = forecast_today(store, walk, profile, walk.walked_s, content, days=max(DAYS_AHEAD) - 1)
    ends = (end[:, 0].tolist() for end in vars(made.picked_by).values())
    return [Span(*line) for line in zip(*ends, strict=True)]


def fruit_kg(picked: Picked, table: Iterable[FruitRow], profile: CropProfile) -> float | None:
    """Return what a picked fruit weighs: as harvested, else by the volume of those in its class."""
    weighed = [(count, kg) for count, kg in picked.values() if count and kg]
    if weighed:
        return sum(kg for _, kg in weighed) / sum(count for count, _ in weighed)
    grades = [grade(view, profile) for view in table]
    masses = [x.mass_g for x in grades if x.mass_g is not None and x.name in profile.pick]
    return fmean(masses) / 1000 if masses else None
