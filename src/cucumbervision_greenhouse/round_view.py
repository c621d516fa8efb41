"""A round as the pages show it, read again only after a change: fruit, grades, forecast."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from itertools import groupby
from typing import Any, TypeVar

import streamlit as st

from cucumbervision.capture.frames import Capture
from cucumbervision.crop.grades import Grade, grade
from cucumbervision.crop.profiles import CropProfile
from cucumbervision_greenhouse.forecast.forecast import Forecast
from cucumbervision_greenhouse.forecast.picking import Pick, Ready, pick_list, ready_on
from cucumbervision_greenhouse.fruit_pictures import as_data_url, crop
from cucumbervision_greenhouse.resources import KEPT, profile_of, rounds, store, worker
from cucumbervision_greenhouse.rounds import day_comparison, forecasting, fruit_table
from cucumbervision_greenhouse.rounds.adding import stored_capture
from cucumbervision_greenhouse.rounds.harvest import Compared, Picked, compare_harvests, harvests
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S, rounds_of_house
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.tasks import mergings, progress

LINES = 20  # fruit on one page of the list
_CUT_PX, _CUT_SHARE = 320, 0.8
_DAYS = 400  # rounds whose numbers are kept: a season
_LOW_CONFIDENCE = 0.45  # confidence below which a fruit with one view may be a false detection


def news(round_key: str) -> dict[str, Any]:
    """Return the news for open pages: waiting and finished work, and the round's version.

    Parameters
    ----------
    round_key : str
        The open round; its `version` changes whenever one of its pages would.
    """
    round_summary = store().round(round_key)
    version = 0 if round_summary is None else hash(_version(round_summary))
    return {
        "version": f"{worker().finished}-{version}",
        "now_s": time.time(),
        "work": vars(progress(round_key)),
    }


def _version(round_summary: records.Round) -> tuple[object, ...]:
    """Return a value that changes whenever a page of the round would."""
    return (*_measured_version(round_summary), store().newest_action(round_summary.key))


def _measured_version(round_summary: records.Round) -> tuple[object, ...]:
    counts = round_summary.stops, round_summary.fruit, round_summary.last_s
    crop = profile_of(round_summary)[1].model_dump_json()
    return (round_summary.key, *counts, mergings()[round_summary.key], crop)


def _unpicked_version(round_summary: records.Round) -> tuple[object, ...]:
    """Return a value that changes with a round's pick list, except when fruit are picked."""
    newest = store().newest_action(round_summary.key, without=("pick", "unpick"))
    return (*_measured_version(round_summary), newest, forecasting.midnight_s(time.time()))


_Reader = TypeVar("_Reader", bound=Callable[..., Any])


def _cached(**options: Any) -> Callable[[_Reader], _Reader]:
    """Keep what a function reads, by default of a round, until the round changes."""
    how: dict[str, Any] = {
        "show_spinner": False,
        "max_entries": KEPT,
        "ttl": 600,
        "hash_funcs": {records.Round: _version},
    }
    keep: Callable[[_Reader], _Reader] = st.cache_resource(**how | options)
    return keep


_OF_FRUIT = {records.FruitRow: lambda view: (view.key, view.corrected, view.box_x1_px)}
_OF_IMAGE: dict[type, Callable[[Any], Any]] = {
    records.StopRecord: lambda stop: (stop.key, stop.row, stop.side, stop.position_m, stop.step),
    records.CaptureRecord: lambda taken: (taken.name, taken.color, taken.depth),
}


@dataclass(frozen=True, eq=False)
class RoundView:
    """A round as it was at one moment; what a page needs of it is computed once.

    Parameters
    ----------
    round : Round
        The round, as lists name it.
    content : fruit_table.RoundContent
        Its stops and views.
    profile : CropProfile
        The crop that grades its fruit.
    """

    round: records.Round
    content: fruit_table.RoundContent
    profile: CropProfile

    @property
    def key(self) -> str:
        """The round's key."""
        return self.round.key

    @cached_property
    def best(self) -> Sequence[records.FruitRow]:
        """Each fruit once with the length from all views, deleted ones included, along the rows."""
        row_of_fruit = {fruit.key: fruit for fruit in fruit_table.fruit_table(self.content)}
        best = [row_of_fruit.get(view.key, view) for view in self.content.views if view.best]
        return sorted(best, key=fruit_table.along_rows)

    @cached_property
    def fruit(self) -> Sequence[records.FruitRow]:
        """The fruit without deleted ones."""
        return [fruit for fruit in self.best if fruit.verdict is not records.Verdict.REJECTED]

    @cached_property
    def shaped(self) -> Sequence[records.FruitRow]:
        """The fruit without deleted ones, with their paths."""
        shapes = {view.key: view for view in store().detections(self.key, shapes=True)}
        return [
            fruit.with_(**shapes[fruit.key].shape) for fruit in self.fruit if fruit.key in shapes
        ]

    @cached_property
    def deleted(self) -> Sequence[records.FruitRow]:
        """Deleted fruit, which no figure counts."""
        return [fruit for fruit in self.best if fruit.verdict is records.Verdict.REJECTED]

    @cached_property
    def grades(self) -> Mapping[str, Grade]:
        """Grades of all fruit by their keys: those of today."""
        return forecasting.grades_today(self.best, self.profile, self.today)

    @cached_property
    def today_m(self) -> Mapping[str, float]:
        """Expected lengths today of fruit that were measured on an earlier day, metres."""
        return forecasting.lengths_today(self.today)

    @property
    def age(self) -> tuple[int, forecasting.Age]:
        """Its age today in calendar days, and its use."""
        return forecasting.age_of(self.round.walked_s, time.time())

    @property
    def today(self) -> Forecast | None:
        """The forecast of today alone; None where the round is too old."""
        return None if self.age[1] is forecasting.Age.USELESS else _today_of(self.round)

    @property
    def picks(self) -> dict[str, list[Pick]]:
        """The pick list by row in the order of the walk, including fruit that were picked today."""
        picks = () if self.today is None else pick_list(self.today)
        return {row: list(of_row) for row, of_row in groupby(picks, lambda pick: pick.fruit.row)}

    @property
    def ready(self) -> Ready | None:
        """The fruit that are ready today; None where the round is too old."""
        picked = {view.key for view in self.fruit if view.picked_s is not None}
        return None if self.today is None else ready_on(self.today, picked=picked)

    @cached_property
    def doubts(self) -> Sequence[str]:
        """The doubts about the data in the core's words, each once."""
        return fruit_table.round_doubts(self.content.views)

    @cached_property
    def forecast(self) -> Forecast:
        """The forecast from today on."""
        return forecasting.forecast_today(
            store(), self.round, self.profile, time.time(), self.content
        )

    @cached_property
    def harvests(self) -> Picked:
        """What was picked in its house by day."""
        return harvests(store(), rounds_of_house(store(), self.key))

    @cached_property
    def compared(self) -> Sequence[Compared]:
        """How far forecasts of its house were from what was picked."""
        walks = rounds_of_house(store(), self.key)
        return compare_harvests(store(), walks, self.profile, self.harvests, date.today())

    def counts(self, fruit: Iterable[records.FruitRow]) -> Counter[str]:
        """Return how many of these fruit are in each class today, by the labels of the classes."""
        return Counter(self.grades[view.key].label for view in fruit)


@_cached()
def view_of(round_summary: records.Round) -> RoundView:
    """Return a round with its stops and views; read again only after a change."""
    content = fruit_table.read_round(store(), round_summary.key)
    return RoundView(round_summary, content, profile_of(round_summary)[1])


@_cached(max_entries=_DAYS, ttl=3600)
def class_counts_of(round_summary: records.Round) -> Counter[str]:
    """Return how many fruit of each class a round shows, those that were picked since as well."""
    walk = view_of(round_summary)
    return class_counts((fruit for fruit in walk.fruit if not fruit.doubtful), walk.profile)


def class_counts(fruit: Iterable[records.FruitRow], profile: CropProfile) -> Counter[str]:
    """Return how many fruit were in each class by a profile when they were measured."""
    return Counter(grade(view, profile).label for view in fruit)


@_cached()
def comparison_of(earlier: records.Round, later: records.Round) -> day_comparison.DayComparison:
    """Return what changed between two rounds of a house; computed again only after a change."""
    contents = [view_of(x).content for x in (earlier, later)]
    return day_comparison.compare_rounds(
        fruit_table.fruit_table(contents[0]),
        fruit_table.fruit_table(contents[1]),
        day_comparison.same_fruit(store(), *contents),
        (contents[0].stops, contents[1].stops),
        (later.walked_s - earlier.walked_s) / DAY_S,
    )


@_cached()
def fruit_days_of(round_summary: records.Round, fruit_key: str) -> list[records.FruitRow]:
    """Return a fruit of a round, or of one before it, on every day, the earliest first."""
    content = view_of(round_summary).content
    if fruit_key not in content.group_of:
        content = fruit_table.read_round(store(), store().detection(fruit_key).view.round_key)
    return day_comparison.fruit_days(store(), content, fruit_key)


@_cached(ttl=3600, hash_funcs={records.Round: _unpicked_version})
def _today_of(round_summary: records.Round) -> Forecast:
    walk = view_of(round_summary)
    return forecasting.forecast_today(
        store(), round_summary, walk.profile, time.time(), walk.content, days=0
    )


@_cached(max_entries=6, ttl=None, hash_funcs=_OF_IMAGE)
def capture_of(stop: records.StopRecord, taken: records.CaptureRecord) -> Capture:
    """Return a capture of a stop with its images; the last ones are held."""
    return stored_capture(store().images, taken, stop)


@st.cache_resource(show_spinner=False, max_entries=2000)
def _widths_px(stop_key: str) -> dict[str, int]:
    return {capture.name: capture.width_px for capture in store().stop(stop_key).captures}


@_cached(max_entries=400, ttl=None, hash_funcs=_OF_FRUIT)
def thumbnail_of(view: records.FruitRow) -> str | None:
    """Return a fruit's thumbnail as a data URL; None where none was kept."""
    if view.thumbnail is None:
        return None
    small = store().images.read_color(view.thumbnail)
    return as_data_url(crop(small, view, _widths_px(view.stop_key)[view.capture]))


@_cached(max_entries=400, ttl=None, hash_funcs=_OF_FRUIT)
def cutout_of(view: records.FruitRow) -> str | None:
    """Return a fruit cut out of its image as a data URL; None where none was kept."""
    captures = store().stop(view.stop_key).captures
    taken = next(capture for capture in captures if capture.name == view.capture)
    if taken.color is None:
        return None
    color = store().images.read_color(taken.color)
    return as_data_url(crop(color, view, taken.width_px, _CUT_PX, _CUT_SHARE))


def read_ahead() -> None:
    """Read the newest round ahead, so that the first page opens without delay."""
    for round_summary in rounds()[:1]:
        walk = view_of(round_summary)
        for fruit in walk.fruit[:LINES]:
            thumbnail_of(fruit)
        _today_of(round_summary)


def doubtful(fruit: Sequence[records.FruitRow]) -> list[records.FruitRow]:
    """Return unjudged fruit with a single view of low confidence, the least certain first."""
    return [view for view in fruit_table.least_sure_first(fruit) if view.score < _LOW_CONFIDENCE]
