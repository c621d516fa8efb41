"""Row map: the rows as they hang, and the stops of the round, to be corrected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import streamlit as st

from cucumbervision.capture.frames import Stop
from cucumbervision_greenhouse import resources, tasks
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.language import counted
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.round_choice import label_options, of_round
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds.merge_and_link import move_stop
from cucumbervision_greenhouse.rounds.walking import sides_of
from cucumbervision_greenhouse.row_drawing import sheet
from cucumbervision_greenhouse.store.records import StopRecord


@of_round
def page(walk: RoundView) -> None:
    """Draw the page."""
    drawing, undo = st.container(), st.container()
    list_stops(walk.key)  # first, since a stop on a third side prevents drawing the rows
    with undo:
        page_elements.draw_undo(walk.key)
    with drawing:
        groups = walk.content.group_of
        missing = _("There is no such fruit in this round (any more).")
        page_elements.say_missing("fruit", groups, missing)
        _rows(walk, groups.get(st.query_params.get("fruit", ""), ""))


def _rows(walk: RoundView, opened: str) -> None:
    if all(fruit.along_m is None for fruit in walk.fruit):
        st.info(
            _("No fruit of this round has a position yet. Enter row and position when capturing."),
            icon=":material/map:",
        )
        return
    drawn = page_elements.rows(walk, opened=opened)
    st.caption(
        _(
            "Fruit with their true size, bend, place and height. Striped: the class is undecided; "
            "an outline: picked. Tap a fruit to open it; two fingers, or Ctrl and wheel, enlarge."
        )
    )
    if (ready := walk.ready) is not None:
        st.caption(texts.ready_words(ready))
    save: dict[str, Any] = {"file_name": f"{walk.round.name or 'row'}.svg", "mime": "image/svg+xml"}
    st.download_button(_("Save as SVG"), sheet(drawn), icon=":material/download:", **save)


def list_stops(round_key: str) -> None:
    """Draw the choice of a stop, and the form that corrects it."""
    stops = {stop.key: stop for stop in resources.store().stops(round_key)}
    key = f"stop_of_{round_key}"
    named = st.query_params.get("stop")  # as the capture page's link does
    missing = _("There is no such stop in this round (any more).")
    page_elements.say_missing("stop", stops, missing)
    if named in stops:
        st.session_state.setdefault(key, named)
    title = _("Stops: move, rename, delete")
    part = page_elements.section(title, "place", "stops", opened=named in stops)
    if part is None:
        return
    with part:
        chosen = st.selectbox(
            _("Stop"),
            list(stops),
            index=None,
            format_func=label_options(key, {index: _words(stop) for index, stop in stops.items()}),
            placeholder=counted(len(stops), "Choose one of {n} stop", "Choose one of {n} stops"),
            key=key,
        )
        if chosen in stops:
            change_stop(stops[chosen], sides_of(stops.values()))


def _words(stop: StopRecord) -> str:
    note = f" ({stop.note})" if stop.note else ""
    name = texts.stop_name(stop, resources.settings().units)
    return f"{name}{note} · {counted(stop.fruit, '{n} fruit', '{n} fruit')}"


def change_stop(stop: StopRecord, sides: Sequence[str]) -> None:
    """Draw a stop's place and name to be changed; `sides` are those of its round.

    A change of the stop by others draws new fields; any other change keeps what was typed.
    """
    unit, per_metre = resources.settings().units.along
    at = None if stop.position_m is None else stop.position_m * per_metre
    names = list(dict.fromkeys([*sides, *filter(None, [stop.side])]))
    index = names.index(stop.side) if stop.side else None
    drawn = f"{stop.key}_{hash((stop.row, stop.side, at, stop.step, stop.note))}"
    keys = {name: f"stop_{name}_{drawn}" for name in ("row", "side", "at", "step", "note")}

    def move() -> int:
        # What the fields hold now: they may have been typed into since they were drawn.
        row, side, at, step, note = (st.session_state[key] for key in keys.values())
        at_m = None if at is None else at / per_metre
        place = Stop(row.strip() or None, (side or "").strip() or None, at_m, step)
        return move_stop(resources.store(), stop, place, note.strip())

    def remove() -> int:
        return resources.store().delete_stop(stop.key)

    row, side, position = st.columns(3)
    number, note = st.columns([1, 2])
    row.text_input(_("Row"), stop.row or "", key=keys["row"])
    how: dict[str, Any] = {"format_func": texts.side_words, "accept_new_options": True}
    side.selectbox(_("Side"), names, index, key=keys["side"], **how)
    label, lowest = _("At [{unit}]").format(unit=unit), min(0.0, at or 0.0)
    position.number_input(label, lowest, None, at, 0.1, "%.2f", key=keys["at"])
    number.number_input(_("Number"), None, None, stop.step, 1, key=keys["step"])
    note.text_input(_("Name"), stop.note, key=keys["note"])
    save, delete = st.columns(2)
    page_elements.button(save, _("Save"), "save", _do, stop.round_key, move)
    page_elements.button(delete, _("Delete this stop"), "delete", _do, stop.round_key, remove)


def _do(round_key: str, act: Callable[[], int]) -> None:
    """Do it, and find the round's fruit anew."""
    act()
    tasks.merge(round_key)
