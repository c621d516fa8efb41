"""Row map: where the fruit hang, and the stops of the round."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision_greenhouse import resources, round_caches
from cucumbervision_greenhouse.language import counted, language, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.map_picture import MAP_PX, map_picture
from cucumbervision_greenhouse.pages.page_elements import button, do, draw_undo, picture
from cucumbervision_greenhouse.pages.stops import list_stops
from cucumbervision_greenhouse.round_tables import map_words, row_and_side
from cucumbervision_greenhouse.rounds.fruit_table import least_sure_first
from cucumbervision_greenhouse.store.records import Verdict

if TYPE_CHECKING:
    from cucumbervision_greenhouse.round_tables import GradedRound
    from cucumbervision_greenhouse.store.records import FruitRow, Round

_ROWS_AT_ONCE = 4


@page_elements.of_round
def page(round_summary: Round) -> None:
    """Draw the page."""
    maps, undo = st.container(), st.container()
    list_stops(round_summary)  # first, since a stop on a third side prevents drawing the map
    with undo:
        draw_undo(round_summary.key)
    with maps:
        opened = _opened(round_summary)
        groups = round_caches.content_of(round_summary).group_of
        page_elements.say_missing(
            "fruit", groups, _("There is no such fruit in this round (any more).")
        )
        _maps(round_summary, opened)


def _maps(round_summary: Round, opened: FruitRow | None) -> None:
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
    named = None if opened is None else row_and_side(opened)
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
                {"row": row, "grid": grid, "opened": opened_here and _answer(graded, opened_here)},
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
    round_summary: Round, row: str, layers: list[dict[str, Any]], content: dict[str, object]
) -> None:
    """Draw a row's map; a tap opens the fruit beside its mark, where it can be judged."""
    key = f"map_{round_summary.key}_{row}"

    def tapped() -> None:
        page_elements.name_in_address("fruit", st.session_state[key].tapped or None)

    def judged() -> None:
        asked = st.session_state[key].judged
        views = _views_of(round_summary, asked["key"])
        if views and asked["act"] != "open":
            verdict = Verdict(asked["act"])
            do(partial(resources.store().set_verdict, [view.key for view in views], verdict))

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


def _answer(graded: GradedRound, fruit: FruitRow) -> dict[str, Any]:
    """Return what is said of a fruit beside its mark."""
    units = resources.settings().units
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


def _opened(round_summary: Round) -> FruitRow | None:
    views = _views_of(round_summary, st.query_params.get("fruit", ""))
    return next((view for view in views if view.best), None)


def _views_of(round_summary: Round, key: str) -> list[FruitRow]:
    """Return all views of the fruit of one of them, as they are in the store now."""
    views = resources.store().detections(round_summary.key)
    groups = {view.group for view in views if view.key == key}
    return [view for view in views if view.group in groups]


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
