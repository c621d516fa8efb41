"""A round as the pages show it: its fruit with their grades, and the lines of tables and charts."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

from cucumbervision.crop.grades import grade
from cucumbervision.run.fields import FIELDS
from cucumbervision_greenhouse.language import decimal_words
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.rounds.fruit_table import hanging_lengths_m, round_figures
from cucumbervision_greenhouse.words import (
    daily_growth_words,
    day_words,
    grade_words,
    interval_words,
    length_words,
    position_words,
    row_name,
    side_words,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from cucumbervision.crop.grades import Grade
    from cucumbervision.crop.profiles import CropProfile
    from cucumbervision_greenhouse.rounds.day_comparison import FruitChange
    from cucumbervision_greenhouse.rounds.from_store import RoundContent
    from cucumbervision_greenhouse.rounds.fruit_table import RoundFigures
    from cucumbervision_greenhouse.settings import Units
    from cucumbervision_greenhouse.store.records import FruitRow, Round


_LOW_CONFIDENCE = 0.45  # confidence below which a fruit with one view may be a false detection


@dataclass(frozen=True, eq=False)
class GradedRound:
    """The fruit of a round with their grades and figures.

    Parameters
    ----------
    fruit : tuple of FruitRow
        Each fruit once: its representative view, with the length from all views.
    deleted : tuple of FruitRow
        Deleted fruit, which no figure counts.
    grades : dict of str to Grade
        By fruit key, of both, in the order of the walk.
    figures : RoundFigures
        Numbers of fruit and their lengths.
    """

    fruit: tuple[FruitRow, ...]
    deleted: tuple[FruitRow, ...]
    grades: Mapping[str, Grade]
    figures: RoundFigures


def grade_round(
    content: RoundContent, table: Sequence[FruitRow], profile: CropProfile
) -> GradedRound:
    """Return a round's fruit with their grades; `table` has its lengths."""
    view_of_fruit = {line.key: line for line in table}
    best = [view for view in content.views if view.best]
    fruit = tuple(view_of_fruit[view.key] for view in best if view.key in view_of_fruit)
    deleted = tuple(view for view in best if view.key not in view_of_fruit)
    grades = {view.key: grade(view_of_fruit.get(view.key, view), profile) for view in best}
    return GradedRound(fruit, deleted, grades, round_figures(content, table))


def doubtful(views: Iterable[FruitRow]) -> list[FruitRow]:
    """Return unjudged fruit with a single view of low confidence."""
    return [
        view
        for view in views
        if view.views == 1 and view.verdict is None and view.score < _LOW_CONFIDENCE
    ]


def figure_lines(record: FruitRow) -> list[dict[str, str]]:
    """Return a line with description and value for each stored figure of a fruit.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> figure_lines(FruitRow(1, diameter_max_m=0.0412))[-1]
    {'What': 'Largest diameter', 'Value': '41.2 mm'}
    """
    lines = []
    for column in FIELDS:
        cell = column.cell(getattr(record, column.si_name, None), column.digits)
        if column.type == "number" and cell is not None and not column.name.startswith("box_"):
            value = f"{decimal_words(f'{cell:g}')} {column.unit}".strip()
            says = _(column.says)
            lines.append({_("What"): says[0].upper() + says[1:], _("Value"): value})
    return lines


def length_lines(
    fruit: Sequence[FruitRow], grades: Mapping[str, Grade], units: Units
) -> list[dict[str, Any]]:
    """Return a line for each measured fruit on the plant for the histogram: length and class."""
    return [
        {"length": units.value(view.length_m), "class": grades[view.key].label}
        for view in fruit
        if hanging_lengths_m([view])
    ]


def map_lines(graded: GradedRound, units: Units) -> list[dict[str, Any]]:
    """Return a line for each fruit with a position: along the row, height, class, length."""
    per_metre = units.along[1]
    return [
        {
            "key": view.key,
            "row": row_and_side(view),
            "along": round(max(view.along_m, 0.0) * per_metre, 2),
            "height": -round((view.centre_y_m or 0.0) * per_metre, 3),
            "length": units.value(view.length_m),
            "class": graded.grades[view.key].label,
            "says": mark_words(view, graded, units),
            "views": view.views,
            "mark": _mark_of(view),
        }
        for view in graded.fruit
        if view.along_m is not None
    ]


def row_and_side(view: FruitRow) -> str:
    """Return the map's name for the row and side of a fruit."""
    return row_name(view.row) + (f", {side_words(view.side)}" if view.side else "")


def last_of_day(rounds: Iterable[Round]) -> list[tuple[str, Round]]:
    """Return the last round of each day with its local date (ISO 8601), the newest day first."""
    last: dict[str, Round] = {}
    for round_summary in sorted(rounds, key=lambda x: -x.walked_s):
        date = datetime.fromtimestamp(round_summary.walked_s).astimezone().date()
        last.setdefault(date.isoformat(), round_summary)
    return list(last.items())


def change_words(fruit: FruitChange, units: Units) -> list[str]:
    """Return what is said of a fruit of two rounds: its place, its two lengths, its growth."""
    view = fruit.after or fruit.before
    if view is None:
        return []
    lengths = [length_words(x, units) for x in (fruit.before, fruit.after) if x is not None]
    growth = fruit.growth_m_per_day
    return [
        f"{row_and_side(view)}, {position_words(view.along_m, units)}",
        " → ".join(lengths),
        "" if growth is None else daily_growth_words(growth, units),
        _("picked") if view.picked_s is not None else "",
    ]


def day_lines(view: FruitRow, units: Units) -> list[str]:
    """Return what is said of a fruit on one day: the date, its length and interval."""
    interval = interval_words(view, units)
    lines = [day_words(view.taken_s), length_words(view, units), interval or ""]
    return [line for line in lines if line]


def length_days(views: Iterable[FruitRow], units: Units) -> list[dict[str, Any]]:
    """Return a line for each day of a fruit with a length: time, length and interval."""
    lines = []
    for view in views:
        length = view.length
        if length is not None:
            # Without a zone: a browser elsewhere would draw another day than the pages say.
            moment = datetime.fromtimestamp(view.taken_s)
            lines.append(
                {
                    "at": moment.isoformat(timespec="minutes"),
                    "length": units.value(length.value_m),
                    "low": units.value(length.low_m),
                    "high": units.value(length.high_m),
                }
            )
    return lines


def map_words(view: FruitRow, graded: GradedRound, units: Units) -> str:
    """Return the map's text on a fruit: its row and side, then `mark_words`."""
    return f"{row_and_side(view)}, {mark_words(view, graded, units)}"


def mark_words(view: FruitRow, graded: GradedRound, units: Units) -> str:
    """Return what is said of a fruit on the map of its row: its position, length and class."""
    grades = [grade_words(graded.grades[view.key])] if view.key in graded.grades else []
    place = position_words(view.along_m, units)
    return ", ".join([f"{place}: {length_words(view, units)}", *grades])


def _mark_of(view: FruitRow) -> str:
    if view.picked_s is not None:
        return "picked"
    return "simulated" if view.simulated else "seen"
