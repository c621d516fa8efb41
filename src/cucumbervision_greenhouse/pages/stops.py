"""Corrections of stops: moved to another row or position, renamed, deleted, undone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.capture.frames import Stop
from cucumbervision_greenhouse import resources, tasks
from cucumbervision_greenhouse.language import counted
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.page_elements import button, do, say_missing
from cucumbervision_greenhouse.pages.round_choice import label_options
from cucumbervision_greenhouse.rounds.merge_and_link import move_stop
from cucumbervision_greenhouse.rounds.walking import sides_of
from cucumbervision_greenhouse.words import side_words, stop_name

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cucumbervision_greenhouse.store.records import Round, StopRecord


# Kinds of action by which others must not take away what is being typed.
_OF_FRUIT = (
    *("accept", "reject", "clear", "pick", "unpick", "correct", "add"),
    *("merge", "unmerge", "link-growth", "unlink-growth"),
)


def list_stops(round_summary: Round) -> None:
    """Draw the choice of a stop, and the form that corrects it."""
    stops = {stop.key: stop for stop in resources.store().stops(round_summary.key)}
    key = f"stop_of_{round_summary.key}"
    named = st.query_params.get("stop")  # as the capture page's link does
    say_missing("stop", stops, _("There is no such stop in this round (any more)."))
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
    name = stop_name(stop, resources.settings().units)
    return f"{name}{note} · {counted(stop.fruit, '{n} fruit', '{n} fruit')}"


def change_stop(stop: StopRecord, sides: Sequence[str]) -> None:
    """Draw a stop's place and name to be changed; `sides` are those of its round."""
    store = resources.store()
    # Fields of new names after each change of a stop: those on the page keep what was typed.
    version = f"{stop.key}_{store.newest_action(stop.round_key, without=_OF_FRUIT)}"
    row, side, position = st.columns(3)
    number, note = st.columns([1, 2])
    row.text_input(_("Row"), stop.row or "", key=f"stop_row_{version}")
    choices = list(dict.fromkeys([*sides, *filter(None, [stop.side])]))
    index = choices.index(stop.side) if stop.side else None
    side.selectbox(
        _("Side"),
        choices,
        index,
        format_func=side_words,
        key=f"stop_side_{version}",
        accept_new_options=True,
    )
    unit, per_metre = resources.settings().units.along
    at = None if stop.position_m is None else stop.position_m * per_metre
    position.number_input(
        _("At [{unit}]").format(unit=unit),
        min(0.0, at or 0.0),
        None,
        at,
        0.1,
        "%.2f",
        key=f"stop_at_{version}",
    )
    number.number_input(_("Number"), None, None, stop.step, 1, key=f"stop_step_{version}")
    note.text_input(_("Name"), stop.note, key=f"stop_note_{version}")

    def move() -> int:
        # What the fields hold now: they may have been typed into since they were drawn.
        names = ("row", "side", "at", "step", "note")
        typed = [st.session_state[f"stop_{name}_{version}"] for name in names]
        row, side, note = ((typed[k] or "").strip() for k in (0, 1, 4))
        at_m = None if typed[2] is None else typed[2] / per_metre
        return move_stop(store, stop, Stop(row or None, side or None, at_m, typed[3]), note)

    def remove() -> int:
        return store.delete_stop(stop.key)

    save, delete = st.columns(2)
    for where, label, icon, act in (
        (save, _("Save"), "save", move),
        (delete, _("Delete this stop"), "delete", remove),
    ):
        button(where, label, icon, _do, stop.round_key, act, key=f"{icon}_{stop.key}")


def _do(round_key: str, act: Callable[[], int]) -> None:
    """Do it, and find the round's fruit anew."""
    if do(act):
        tasks.merge(round_key)
