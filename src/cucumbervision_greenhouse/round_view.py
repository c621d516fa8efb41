"""A round as the pages show it, read again only after a change: fruit, grades, forecast."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision.capture.frames import Capture
from cucumbervision.crop.grades import grade
from cucumbervision.run.fields import FIELDS
from cucumbervision_greenhouse.forecast.forecast import Forecast
from cucumbervision_greenhouse.forecast.picking import Ready, ready_on
from cucumbervision_greenhouse.fruit_pictures import as_data_url, crop
from cucumbervision_greenhouse.language import decimal_words
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.resources import KEPT, profile_of, rounds, store, worker
from cucumbervision_greenhouse.rounds.adding import stored_capture
from cucumbervision_greenhouse.rounds.day_comparison import (
    DayComparison,
    compare_rounds,
    fruit_days,
    same_fruit,
)
from cucumbervision_greenhouse.rounds.forecasting import (
    Today,
    forecast_today,
    grades_today,
    lengths_today,
    midnight_s,
    read_today,
)
from cucumbervision_greenhouse.rounds.fruit_table import (
    RoundContent,
    fruit_table,
    hanging_lengths_m,
    read_round,
    round_doubts,
    round_figures,
)
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S, earlier_rounds
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    DetectionDetail,
    FruitRow,
    Round,
    StopRecord,
)
from cucumbervision_greenhouse.tasks import mergings, progress
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
    from collections.abc import Iterable, Mapping

    from cucumbervision.crop.grades import Grade
    from cucumbervision.crop.profiles import CropProfile
    from cucumbervision_greenhouse.rounds.day_comparison import FruitChange
    from cucumbervision_greenhouse.rounds.fruit_table import RoundFigures


_CUT_PX, _CUT_SHARE = 320, 0.8
LINES = 20  # fruit on one page of the list
_DAYS = 400  # rounds whose numbers are kept: a season


def news(round_key: str) -> dict[str, Any]:
    """Return the news for open pages: waiting and finished work, and the round's version.

    Parameters
    ----------
    round_key : str
        The open round; its `version` changes whenever one of its pages would.
    """
    round_summary = store().round(round_key)
    counts = (worker().finished, 0 if round_summary is None else hash(_version(round_summary)))
    return {
        "version": f"{counts[0]}-{counts[1]}",
        "now_s": time.time(),
        "work": progress(round_key).told,
    }


def _version(round_summary: Round) -> tuple[object, ...]:
    """Return a value that changes whenever a page of the round would."""
    return (*_measured_version(round_summary), store().newest_action(round_summary.key))


def _measured_version(round_summary: Round) -> tuple[object, ...]:
    counts = round_summary.stops, round_summary.fruit, round_summary.last_s
    crop = profile_of(round_summary)[1].model_dump_json()
    return (round_summary.key, *counts, mergings()[round_summary.key], crop)


_HASH_OF_ROUND: dict[str | type[Any], Callable[[Any], Any]] = {Round: _version}
_HASH_OF_WORDS = _HASH_OF_ROUND | {Units: lambda units: units.name}
_HASH_OF_FRUIT: dict[str | type[Any], Callable[[Any], Any]] = {
    FruitRow: lambda view: (view.key, view.corrected, view.box_x1_px)
}


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600, hash_funcs=_HASH_OF_ROUND)
def content_of(round_summary: Round) -> RoundContent:
    """Return a round's stops and detections; read again only after a change."""
    return read_round(store(), round_summary.key)


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=120, hash_funcs=_HASH_OF_ROUND)
def graded_round(round_summary: Round) -> GradedRound:
    """Return a round's fruit and grades of today; computed again only after a change."""
    return grade_round(
        content_of(round_summary),
        fruit_of(round_summary),
        profile_of(round_summary)[1],
        today_of(round_summary).forecast,
    )


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=120, hash_funcs=_HASH_OF_WORDS)
def map_lines_of(round_summary: Round, units: Units, language: str) -> list[dict[str, Any]]:  # noqa: ARG001, of the words
    """Return the marks of a round's map in a unit and a language; made again after a change."""
    return map_lines(graded_round(round_summary), units)


@st.cache_resource(show_spinner=False, max_entries=_DAYS, ttl=3600, hash_funcs=_HASH_OF_ROUND)
def class_counts_of(round_summary: Round) -> Counter[str]:
    """Return how many fruit of each class a round shows, those that were picked since as well."""
    return class_counts(round_summary, [x for x in fruit_of(round_summary) if not x.doubtful])


def class_counts(round_summary: Round, fruit: Iterable[FruitRow]) -> Counter[str]:
    """Return how many fruit were in each class when a round measured them."""
    profile = profile_of(round_summary)[1]
    return Counter(grade(view, profile).label for view in fruit)


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600, hash_funcs=_HASH_OF_ROUND)
def comparison_of(earlier: Round, later: Round) -> DayComparison:
    """Return what changed between two rounds of a house; computed again only after a change."""
    between = [
        x
        for x in earlier_rounds(store(), later.key)
        if earlier.walked_s < x.walked_s < later.walked_s
    ]
    rounds_in_order = [earlier, *between[::-1], later]
    contents = [content_of(x) for x in rounds_in_order]
    return compare_rounds(
        fruit_of(earlier),
        fruit_of(later),
        same_fruit(store(), contents),
        (contents[0].stops, contents[-1].stops),
        (later.walked_s - earlier.walked_s) / DAY_S,
    )


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=120, hash_funcs=_HASH_OF_ROUND)
def fruit_days_of(round_summary: Round, fruit_key: str) -> list[FruitRow]:
    """Return a fruit of a round, or of one before it, on every day, the earliest first."""
    views = {view.key for view in content_of(round_summary).views}
    home = round_summary.key if fruit_key in views else store().detection(fruit_key).view.round_key
    return fruit_days(store(), home, fruit_key)


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600, hash_funcs=_HASH_OF_ROUND)
def doubts_of(round_summary: Round) -> list[str]:
    """Return the doubts about the data of a round in the core's words, each once."""
    return round_doubts(content_of(round_summary).views)


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600, hash_funcs=_HASH_OF_ROUND)
def fruit_of(round_summary: Round) -> Sequence[FruitRow]:
    """Return a round's fruit with the lengths from all views; computed again after a change."""
    return fruit_table(content_of(round_summary))


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600, hash_funcs=_HASH_OF_ROUND)
def forecast_of(round_summary: Round) -> Forecast:
    """Return a round's forecast from today on; computed again only after a change."""
    return forecast_today(
        store(), round_summary, profile_of(round_summary)[1], time.time(), content_of(round_summary)
    )


def _unpicked_version(round_summary: Round) -> tuple[object, ...]:
    """Return a value that changes with a round's pick list, except when fruit are picked."""
    newest = store().newest_action(round_summary.key, without=("pick", "unpick"))
    return (*_measured_version(round_summary), newest, midnight_s(time.time()))


@st.cache_resource(
    show_spinner=False, max_entries=KEPT, ttl=3600, hash_funcs={Round: _unpicked_version}
)
def today_of(round_summary: Round) -> Today:
    """Return a round's figures of today, including the fruit that were picked today."""
    return read_today(
        store(), round_summary, profile_of(round_summary)[1], time.time(), content_of(round_summary)
    )


def ready_today(round_summary: Round) -> Ready | None:
    """Return the fruit of a round that are ready today; None where it is too old."""
    forecast = today_of(round_summary).forecast
    picked = {view.key for view in fruit_of(round_summary) if view.picked_s is not None}
    return None if forecast is None else ready_on(forecast, picked=picked)


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=120, hash_funcs=_HASH_OF_ROUND)
def fruit_detail(round_summary: Round, fruit_key: str) -> DetectionDetail:  # noqa: ARG001, its version
    """Return one fruit with all its data."""
    return store().detection(fruit_key)


@st.cache_resource(show_spinner=False, max_entries=2000)
def _capture_widths(stop_key: str) -> dict[str, int]:
    return {capture.name: capture.width_px for capture in store().stop(stop_key).captures}


_HASH_OF_PICTURE: dict[str | type[Any], Callable[[Any], Any]] = {
    StopRecord: lambda stop: (stop.key, stop.row, stop.side, stop.position_m, stop.step),
    CaptureRecord: lambda taken: (taken.name, taken.color, taken.depth),
}


@st.cache_resource(show_spinner=False, max_entries=6, hash_funcs=_HASH_OF_PICTURE)
def capture_of(stop: StopRecord, taken: CaptureRecord) -> Capture:
    """Return a capture of a stop with its pictures; the last ones are held."""
    return stored_capture(store().images, taken, stop)


@st.cache_resource(show_spinner=False, max_entries=400, hash_funcs=_HASH_OF_FRUIT)
def thumbnail_of(view: FruitRow) -> str | None:
    """Return a fruit's thumbnail as a data URL; None where none was kept."""
    if view.thumbnail is None:
        return None
    small = store().images.read_color(view.thumbnail)
    return as_data_url(crop(small, view, _capture_widths(view.stop_key)[view.capture]))


@st.cache_resource(show_spinner=False, max_entries=400, hash_funcs=_HASH_OF_FRUIT)
def cutout_of(view: FruitRow) -> str | None:
    """Return a fruit cut out of its picture as a data URL; None where none was kept."""
    captures = {capture.name: capture for capture in store().stop(view.stop_key).captures}
    taken = captures[view.capture]
    if taken.color is None:
        return None
    color = store().images.read_color(taken.color)
    return as_data_url(crop(color, view, taken.width_px, _CUT_PX, _CUT_SHARE))


def read_ahead() -> None:
    """Read the newest round ahead, so that the first page opens without delay."""
    for round_summary in rounds()[:1]:
        for view in graded_round(round_summary).fruit[:LINES]:
            thumbnail_of(view)
        forecast_of(round_summary)
        today_of(round_summary)


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
        By fruit key, of both, in the order of the walk: those of today.
    today_m : dict of str to float
        Expected lengths today of the fruit that were measured on an earlier day, metres.
    figures : RoundFigures
        Numbers of fruit and their lengths.
    """

    fruit: tuple[FruitRow, ...]
    deleted: tuple[FruitRow, ...]
    grades: Mapping[str, Grade]
    figures: RoundFigures
    today_m: Mapping[str, float]


def grade_round(
    content: RoundContent,
    table: Sequence[FruitRow],
    profile: CropProfile,
    forecast: Forecast | None = None,
) -> GradedRound:
    """Return a round's fruit with their grades; `table` has its lengths."""
    view_of_fruit = {line.key: line for line in table}
    best = [view for view in content.views if view.best]
    fruit = tuple(view_of_fruit[view.key] for view in best if view.key in view_of_fruit)
    deleted = tuple(view for view in best if view.key not in view_of_fruit)
    lines = [view_of_fruit.get(view.key, view) for view in best]
    grades = grades_today(lines, profile, forecast)
    figures = round_figures(content, table)
    return GradedRound(fruit, deleted, grades, figures, lengths_today(forecast))


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
    """Return the words for a fruit of two rounds: its place, its two lengths, its growth."""
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
    """Return the words for a fruit on one day: the date, its length and interval."""
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
    """Return the words for a fruit on the map of its row: its position, length and class."""
    grades = [grade_words(graded.grades[view.key])] if view.key in graded.grades else []
    place = position_words(view.along_m, units)
    return ", ".join([f"{place}: {length_words(view, units)}", *grades])


def _mark_of(view: FruitRow) -> str:
    if view.picked_s is not None:
        return "picked"
    return "simulated" if view.simulated else "seen"
