"""Row map: where the fruit hang, how many there are, and corrections of the merging."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.charts import map_chart
from cucumbervision.dashboard.page_elements import button
from cucumbervision.dashboard.round_tables import map_lines
from cucumbervision.dashboard.views.stops import list_stops
from cucumbervision.dashboard.words import (
    count_words,
    counted,
    grade_words,
    length_words,
    metres_words,
    plain,
    round_day,
    row_name,
    step_words,
)
from cucumbervision.errors import CucumberVisionError
from cucumbervision.rounds.fruit_table import around, least_sure_first
from cucumbervision.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cucumbervision.dashboard.round_tables import GradedRound
    from cucumbervision.rounds.fruit_table import FruitContext, OtherDay
    from cucumbervision.store.views import DetectionView, RoundView

_ROWS_AT_ONCE = 4
_SHORT_M = 2.0  # of which all is shown
# Beside the mark that was tapped, also where the chart fills a phone's screen.
_SHOW_ANSWER = """<script>setTimeout(() => document.querySelector('.st-key-answer')
?.scrollIntoView({block: 'nearest'}), 300);</script>"""


@page_elements.of_round
def page(one: RoundView) -> None:
    """Draw the page."""
    above = st.container()
    list_stops(one)  # before the rest, which a stop on a third side keeps from being drawn
    with above:
        _map(one)


def _map(one: RoundView) -> None:
    units = resources.settings().units
    graded = resources.graded_round(one)
    lines = map_lines(graded, units)
    if not lines:
        st.info(
            "No fruit of this round has a position yet. Enter row and position when capturing.",
            icon=":material/map:",
        )
        return
    by, where = st.columns([2, 3], vertical_alignment="bottom")
    st.session_state.setdefault("color_by", "Class")
    colored = by.segmented_control("Colour by", ["Class", "Length"], key="color_by", required=True)
    rows = sorted({line["row"] for line in lines})
    chosen = where.pills(
        "Rows and sides", rows, default=rows[:_ROWS_AT_ONCE], selection_mode="multi"
    )
    if not chosen:
        st.info("Choose a row.", icon=":material/map:")
        return
    for report in resources.rows_of(one):
        st.markdown(f"**{plain(row_name(report.row))}**: {count_words(report.count)}")
    shown = _part([line for line in lines if line["row"] in chosen])
    found = _opened(one)
    for row in [row for row in rows if row in chosen]:
        st.caption(plain(row))
        here = [line for line in shown if line["row"] == row]
        chart = map_chart(here, shown, units, by_length=colored == "Length")
        event = st.altair_chart(chart, on_select="rerun", key=f"map_{one.key}_{row}")
        tapped = [str(x["key"]) for x in event["selection"].get("fruit", [])]
        is_new = _choose(f"{one.key}_{row}", tapped)
        if is_new:
            found = _opened(one)
        if found is not None and any(line["key"] == found.fruit.key for line in here):
            _fruit(one, graded, found)
            found = None
            if is_new:
                st.html(_SHOW_ANSWER, unsafe_allow_javascript=True)
    st.caption(
        "One mark per fruit: a cross if it was picked, a diamond if it is computer-made, hollow if "
        "it was seen from one stop only. Tap a mark to see the fruit. Heights are relative to the "
        "camera."
    )
    _doubtful(graded)
    if found is not None:  # of a row, or a part of it, that is not shown
        _fruit(one, graded, found)


def _part(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Draw the choice of a part of the rows, which is drawn as wide as all; return its fruit."""
    end_m = math.ceil(max(line["along"] for line in lines))
    if end_m <= _SHORT_M:
        return lines
    part = st.slider("From and to, metres along the row", 0, end_m, (0, end_m), key="map_part")
    return [line for line in lines if part[0] <= line["along"] <= part[1]]


def _opened(one: RoundView) -> FruitContext | None:
    key = st.query_params.get("fruit")
    return around(resources.store(), one.key, key) if key else None


def _choose(chart: str, keys: Sequence[str]) -> bool:
    """Use a tap on a mark once, as a later choice elsewhere is kept; return whether it is new."""
    taps = st.session_state.setdefault("map_taps", {})
    is_new = bool(keys) and taps.get(chart) != keys[0]
    if is_new:
        taps[chart] = keys[0]
        page_elements.name_in_address("fruit", keys[0])
    return is_new


def _doubtful(graded: GradedRound) -> None:
    left = least_sure_first(graded.fruit)
    if not left:
        return

    def look() -> None:
        keys = [view.key for view in left]
        now = st.query_params.get("fruit")
        at = keys.index(now) + 1 if now in keys else 0
        page_elements.name_in_address("fruit", keys[at % len(keys)])

    words = counted(len(left), "fruit was", "fruit were")
    says, go = st.columns([3, 2], vertical_alignment="center")
    says.markdown(f"{words} seen from one stop only: may be wrong or counted twice.")
    button(go, "Show the least certain", "visibility", look)


def _fruit(one: RoundView, graded: GradedRound, found: FruitContext) -> None:
    units, fruit = resources.settings().units, found.fruit
    grade = grade_words(graded.grades[fruit.key]) if fruit.key in graded.grades else ""
    place = f"{row_name(fruit.row)}, {fruit.side or ''}, {metres_words(fruit.along_m)}"
    with st.container(key="answer"):
        st.subheader(plain(f"{place}: {length_words(fruit.record, units)}, {grade}"))
        _judge(one, found)
    store = resources.store()
    apart = None if len(found.views) == 1 else ("Different fruit", "call_split", store.unmerge)
    seen = f"Seen {counted(len(found.views), 'time', 'times')}"
    _pictures(fruit.key, seen, found.views, apart)
    same = ("Same fruit", "merge", partial(store.merge, fruit.key))
    _pictures(fruit.key, "Fruit nearby", found.near, same)
    for day, is_earlier in ((found.earlier, True), (found.later, False)):
        if day is not None:
            _other_day(fruit, day, is_earlier=is_earlier)


def _judge(one: RoundView, found: FruitContext) -> None:
    store = resources.store()
    keys = [view.key for view in found.views]
    with st.container(horizontal=True):
        accept, reject = (
            partial(store.set_verdict, keys, x) for x in (Verdict.ACCEPTED, Verdict.REJECTED)
        )
        button(st, "This is a fruit", "check", _do, accept, key=f"accept_{found.fruit.key}")
        button(st, "Not a fruit", "delete", _do, reject, key=f"reject_{found.fruit.key}")
    with st.container(horizontal=True):
        page_elements.link("results", "Open", fruit=found.fruit.key)
        button(st, "Undo", "undo", _undo, one)
    if found.fruit.verdict is not None:
        accepted = found.fruit.verdict is Verdict.ACCEPTED
        st.caption("Marked: a fruit." if accepted else "Marked: not a fruit.")
    if fault := st.session_state.pop("map_fault", None):
        st.warning(plain(fault), icon=":material/error:")


def _other_day(fruit: DetectionView, day: OtherDay, *, is_earlier: bool) -> None:
    store = resources.store()

    def link(key: str) -> int:
        if day.linked is not None:
            _do(partial(part, day.linked.key))
        pair = (key, fruit.key) if is_earlier else (fruit.key, key)
        return store.link_growth(*pair)

    def part(key: str) -> int:
        pair = (key, fruit.key) if is_earlier else (fruit.key, key)
        return store.unlink_growth(*pair)

    when = round_day(day.round.record.started_s)
    if day.linked is not None:
        act = ("Different fruit", "link_off", part)
        _pictures(fruit.key, f"The same fruit on {when}", [day.linked], act)
    _pictures(fruit.key, f"Fruit nearby on {when}", day.near, ("Same fruit", "link", link))


def _pictures(
    of: str,
    title: str,
    views: Sequence[DetectionView],
    act: tuple[str, str, Callable[[str], int]] | None,
) -> None:
    """Draw views side by side, each with what can be done about it to the fruit `of`."""
    if not views:
        return
    units = resources.settings().units
    st.markdown(f"**{title}**")

    def words(view: DetectionView) -> str:
        place = f"{step_words(view.step).lower()} · {metres_words(view.along_m)}"
        return f"{length_words(view.record, units)} · {place}"

    def draw(view: DetectionView) -> None:
        if act is not None:
            label, icon, do = act
            button(st, label, icon, _do, partial(do, view.key), key=f"{label}_{of}_{view.key}")

    page_elements.pictures(views, words, draw)


def _do(act: Callable[[], int]) -> None:
    """Do what was tapped, and remember its number for 'Undo'."""
    try:
        st.session_state.setdefault("map_acts", []).append(act())
    except CucumberVisionError as error:
        st.session_state["map_fault"] = str(error)


def _undo(one: RoundView) -> None:
    acts: list[int] = st.session_state.setdefault("map_acts", [])
    number = acts[-1] if acts else None
    try:
        resources.undo(None if number else one.key, number=number)
    except CucumberVisionError as error:
        st.session_state["map_fault"] = str(error)
    else:
        del acts[-1:]
