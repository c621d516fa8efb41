"""Row map: where the fruit hang, how many there are, and corrections of the merging."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision_greenhouse.backend import resources, round_caches
from cucumbervision_greenhouse.backend.fruit_words import length_words
from cucumbervision_greenhouse.backend.language import counted, language
from cucumbervision_greenhouse.backend.language import gettext as _
from cucumbervision_greenhouse.backend.plain_text import plain
from cucumbervision_greenhouse.backend.round_tables import map_words, row_and_side
from cucumbervision_greenhouse.backend.round_words import (
    count_words,
    position_words,
    round_day,
    row_name,
    step_words,
)
from cucumbervision_greenhouse.dashboard import page_elements
from cucumbervision_greenhouse.dashboard.map_picture import MAP_PX, map_picture
from cucumbervision_greenhouse.dashboard.page_elements import button, do, draw_undo, picture
from cucumbervision_greenhouse.dashboard.views.stops import list_stops
from cucumbervision_greenhouse.rounds.fruit_table import around, least_sure_first
from cucumbervision_greenhouse.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cucumbervision_greenhouse.backend.round_tables import GradedRound
    from cucumbervision_greenhouse.rounds.fruit_table import FruitContext, OtherDay
    from cucumbervision_greenhouse.store.views import DetectionSummary, RoundSummary

_ROWS_AT_ONCE = 4


@page_elements.of_round
def page(round_summary: RoundSummary) -> None:
    """Draw the page."""
    maps, undo, views = st.container(), st.container(), st.container()
    list_stops(round_summary)  # first, since a stop on a third side prevents drawing the map
    with undo:
        draw_undo(round_summary.key)
    with maps:
        opened = _opened(round_summary)
        keys = {view.key for view in opened.views} if opened else ()
        page_elements.say_missing(
            "fruit", keys, _("There is no such fruit in this round (any more).")
        )
        _maps(round_summary, opened)
    with views:
        if opened is not None:
            _same(opened)


def _maps(round_summary: RoundSummary, opened: FruitContext | None) -> None:
    units = resources.settings().units
    graded = round_caches.graded_round(round_summary)
    lines = round_caches.map_lines_of(round_summary, units, language())
    if not lines:
        st.info(
            _("No fruit of this round has a position yet. Enter row and position when capturing."),
            icon=":material/map:",
        )
        return
    by, where = st.columns([2, 3], vertical_alignment="bottom")
    st.session_state.setdefault("color_by", "class")
    scales = {"class": _("Class"), "length": _("Length")}
    colored = by.segmented_control(
        _("Colour by"),
        list(scales),
        format_func=lambda name: scales.get(name, name),
        key="color_by",
        required=True,
    )
    rows = sorted({line["row"] for line in lines})
    chosen = where.pills(
        _("Rows and sides"),
        rows,
        default=rows[:_ROWS_AT_ONCE],
        format_func=plain,
        selection_mode="multi",
    )
    for report in round_caches.rows_of(round_summary):
        st.markdown(f"**{plain(row_name(report.row))}**: {count_words(report)}")
    named = None if opened is None else row_and_side(opened.fruit)
    drawn = [row for row in rows if row in chosen or row == named]
    drawn_lines = [line for line in lines if line["row"] in drawn]
    abreast = st.columns(min(2, max(len(drawn), 1)))
    for number, row in enumerate(drawn):
        with abreast[number % len(abreast)]:
            st.caption(plain(row))
            row_lines = [line for line in drawn_lines if line["row"] == row]
            layers, grid = map_picture(row_lines, drawn_lines, units, by_length=colored == "length")
            opened_here = opened if row == named else None
            _row(
                round_summary,
                row,
                layers,
                {
                    "row": row,
                    "grid": grid,
                    "opened": opened_here and _answer(graded, opened_here),
                },
            )
    st.caption(
        _(
            "One mark per fruit: a cross if it was picked, a diamond if it is computer-made, pale "
            "if it was seen from one stop only. Tap a mark to see the fruit. Heights are relative "
            "to the camera."
        )
    )
    _doubtful(graded)


def _row(
    round_summary: RoundSummary, row: str, layers: list[dict[str, Any]], content: dict[str, object]
) -> None:
    """Draw a row's map; a tap opens the fruit beside its mark, where it can be judged."""
    key = f"map_{round_summary.key}_{row}"

    def tapped() -> None:
        page_elements.name_in_address("fruit", st.session_state[key].tapped or None)

    def judged() -> None:
        asked = st.session_state[key].judged
        context = around(resources.store(), round_summary.key, asked["key"])
        if context is not None and asked["act"] != "open":
            keys = [view.key for view in context.views]
            verdict = Verdict(asked["act"])
            do(partial(resources.store().set_verdict, keys, verdict))

    told = picture(
        key,
        {},
        MAP_PX,
        layers=layers,
        title=_("Map of {row}").format(row=row),
        content=content,
        on={"tapped": tapped, "judged": judged},
    )
    if told.judged and told.judged["act"] == "open":
        page_elements.leave_for("results", fruit=told.judged["key"])


def _answer(graded: GradedRound, context: FruitContext) -> dict[str, Any]:
    """Return what is said of a fruit beside its mark."""
    fruit, units = context.fruit, resources.settings().units
    verdicts = {
        None: "",
        Verdict.ACCEPTED: f". {_('Marked: a fruit.')}",
        Verdict.REJECTED: f". {_('Marked: not a fruit.')}",
    }
    return {
        "key": fruit.key,
        "picture": round_caches.thumbnail_of(fruit),
        "says": map_words(fruit, graded, units) + verdicts[fruit.verdict],
        "verdict": fruit.verdict,
    }


def _opened(round_summary: RoundSummary) -> FruitContext | None:
    key = st.query_params.get("fruit")
    return around(resources.store(), round_summary.key, key) if key else None


def _doubtful(graded: GradedRound) -> None:
    unsure = least_sure_first(graded.fruit)
    if not unsure:
        return

    def look() -> None:
        keys = [view.key for view in unsure]
        current = st.query_params.get("fruit")
        index = keys.index(current) + 1 if current in keys else 0
        page_elements.name_in_address("fruit", keys[index % len(keys)])

    words = counted(
        len(unsure),
        "{n} fruit was seen from one stop only: may be wrong or counted twice.",
        "{n} fruit were seen from one stop only: may be wrong or counted twice.",
    )
    says, go = st.columns([3, 2], vertical_alignment="center")
    says.markdown(words)
    button(go, _("Show the least certain"), "visibility", look)


def _same(context: FruitContext) -> None:
    """Draw the views of a fruit, its neighbours and those of other days, to be told apart."""
    fruit, store = context.fruit, resources.store()
    apart = None if len(context.views) == 1 else (_("Different fruit"), "call_split", store.unmerge)
    title = counted(len(context.views), "Seen {n} time", "Seen {n} times")
    _pictures(fruit, title, context.views, apart)
    same = (_("Same fruit"), "merge", partial(store.merge, fruit.key))
    _pictures(fruit, _("Fruit nearby"), context.neighbours, same)
    for day, is_earlier in ((context.earlier, True), (context.later, False)):
        if day is not None:
            _other_day(fruit, day, is_earlier=is_earlier)


def _other_day(fruit: DetectionSummary, day: OtherDay, *, is_earlier: bool) -> None:
    store = resources.store()

    def link(key: str) -> int:
        if day.linked is not None:
            do(partial(part, day.linked.key))
        pair = (key, fruit.key) if is_earlier else (fruit.key, key)
        return store.link_growth(*pair)

    def part(key: str) -> int:
        pair = (key, fruit.key) if is_earlier else (fruit.key, key)
        return store.unlink_growth(*pair)

    when = round_day(day.round.walked_s)
    if day.linked is not None:
        act = (_("Different fruit"), "link_off", part)
        title = _("The same fruit on {day}").format(day=when)
        _pictures(fruit, title, [day.linked], act)
    title = _("Fruit nearby on {day}").format(day=when)
    _pictures(fruit, title, day.neighbours, (_("Same fruit"), "link", link))


def _pictures(
    shown_fruit: DetectionSummary,
    title: str,
    views: Sequence[DetectionSummary],
    act: tuple[str, str, Callable[[str], int]] | None,
) -> None:
    """Draw views side by side, each with what can be done about it to `shown_fruit`."""
    if not views:
        return
    units = resources.settings().units
    st.markdown(f"**{title}**")

    def words(view: DetectionSummary) -> str:
        place = f"{step_words(view.step).lower()} · {position_words(view.along_m, units)}"
        return f"{length_words(view.record, units)} · {place}"

    def draw(view: DetectionSummary) -> None:
        if act is not None:
            label, icon, change = act
            name = f"{label}_{shown_fruit.key}_{view.key}"
            button(st, label, icon, do, partial(change, view.key), key=name)

    page_elements.pictures(views, words, draw)
