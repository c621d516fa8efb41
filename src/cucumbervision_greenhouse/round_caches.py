"""Caches of what pages show of a round, read again only after a change."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import streamlit as st

from cucumbervision.capture.frames import Capture
from cucumbervision_greenhouse.forecast.forecast import Forecast
from cucumbervision_greenhouse.fruit_pictures import as_data_url, crop
from cucumbervision_greenhouse.resources import KEPT, profile_of, rounds, store, worker
from cucumbervision_greenhouse.round_tables import GradedRound, grade_round, map_lines
from cucumbervision_greenhouse.rounds.data_doubts import round_doubts
from cucumbervision_greenhouse.rounds.day_comparison import (
    DayComparison,
    compare_rounds,
    fruit_days,
    same_fruit,
)
from cucumbervision_greenhouse.rounds.forecasting import (
    Today,
    forecast_today,
    midnight_s,
    read_today,
)
from cucumbervision_greenhouse.rounds.from_store import RoundContent, read_round
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S, earlier_rounds
from cucumbervision_greenhouse.rounds.stop_records import stored_capture
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    DetectionDetail,
    FruitRow,
    Round,
    StopRecord,
)
from cucumbervision_greenhouse.tasks import mergings, progress

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
    """Return a round's fruit and grades; computed again only after a change."""
    return grade_round(
        content_of(round_summary), fruit_of(round_summary), profile_of(round_summary)[1]
    )


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=120, hash_funcs=_HASH_OF_WORDS)
def map_lines_of(round_summary: Round, units: Units, language: str) -> list[dict[str, Any]]:  # noqa: ARG001, of the words
    """Return the marks of a round's map in a unit and a language; made again after a change."""
    return map_lines(graded_round(round_summary), units)


@st.cache_resource(show_spinner=False, max_entries=_DAYS, ttl=3600, hash_funcs=_HASH_OF_ROUND)
def class_counts_of(round_summary: Round) -> Counter[str]:
    """Return how many fruit of each class a round shows, those that were picked since as well."""
    graded = graded_round(round_summary)
    return Counter(graded.grades[view.key].label for view in graded.fruit if not view.doubtful)


@st.cache_resource(show_spinner="Comparing …", max_entries=KEPT, ttl=600, hash_funcs=_HASH_OF_ROUND)
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


@st.cache_resource(
    show_spinner="Forecasting …", max_entries=KEPT, ttl=600, hash_funcs=_HASH_OF_ROUND
)
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
    show_spinner="Forecasting …", max_entries=KEPT, ttl=3600, hash_funcs={Round: _unpicked_version}
)
def today_of(round_summary: Round) -> Today:
    """Return a round's figures of today, including the fruit that were picked today."""
    return read_today(
        store(), round_summary, profile_of(round_summary)[1], time.time(), content_of(round_summary)
    )


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
