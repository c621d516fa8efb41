"""Stops put right: moved to another row or position, renamed, deleted; what was done is undone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.capture.frames import Stop
from cucumbervision.dashboard import resources
from cucumbervision.dashboard.page_elements import button
from cucumbervision.dashboard.plain_text import plain
from cucumbervision.dashboard.round_tables import counted, stop_name
from cucumbervision.errors import CucumberVisionError
from cucumbervision.rounds.walking import put_right

if TYPE_CHECKING:
    from collections.abc import Callable

    from cucumbervision.store.views import RoundView, StopView

__all__ = ["change_stop", "list_stops"]


def list_stops(one: RoundView) -> None:
    """Draw the choice of a stop, and what can be put right about it."""
    with st.expander("Stops: move, rename, delete", icon=":material/place:"):
        stops = {stop.key: stop for stop in resources.store().stops(one.key)}
        chosen = st.selectbox(
            "Stop",
            list(stops),
            index=None,
            format_func=lambda key: _words(stops[key]),
            placeholder=f"Choose one of {counted(len(stops), 'stop', 'stops')}",
            key=f"stop_of_{one.key}",
        )
        if chosen in stops:
            change_stop(stops[chosen])
        else:
            _undo_button(one.key)


def _words(stop: StopView) -> str:
    note = f" ({stop.note})" if stop.note else ""
    return f"{stop_name(stop)}{note} · {stop.fruit} fruit"


def change_stop(stop: StopView) -> None:
    """Draw a stop's place and name to be changed."""
    given = f"{stop.key}_{stop.row}_{stop.side}_{stop.position_m}_{stop.step}"
    row, side, position = st.columns(3)
    number, note = st.columns([1, 2])
    sides = list(dict.fromkeys(["left", "right", *filter(None, [stop.side])]))
    place = Stop(
        row.text_input("Row", stop.row or "", key=f"stop_row_{given}").strip() or None,
        side.selectbox("Side", sides, _at(sides, stop.side), key=f"stop_side_{given}"),
        position.number_input(
            "At [m]", 0.0, None, stop.position_m, 0.1, "%.2f", key=f"stop_at_{given}"
        ),
        number.number_input("Number", 0, None, stop.step, key=f"stop_step_{given}"),
    )
    name = note.text_input("Name", stop.note, key=f"stop_note_{given}").strip()
    store = resources.store()
    save, delete, undo = st.columns(3)

    def move() -> int:
        return put_right(store, stop, place, name)

    def remove() -> int:
        return store.delete_stop(stop.key)

    for where, label, icon, act in (
        (save, "Save", "save", move),
        (delete, "Delete this stop", "delete", remove),
    ):
        button(where, label, icon, _do, stop.round_key, act, key=f"{label}_{stop.key}")
    with undo:
        _undo_button(stop.round_key)


def _at(sides: list[str], side: str | None) -> int | None:
    return sides.index(side) if side in sides else None


def _do(round_key: str, act: Callable[[], int]) -> None:
    """Do it, find the round's fruit anew, and remember what was done."""
    acts: list[int] = st.session_state.setdefault(f"stop_acts_{round_key}", [])
    try:
        acts.append(act())
    except CucumberVisionError as error:
        st.session_state["stop_fault"] = str(error)
    else:
        resources.merge(round_key)


def _undo_button(round_key: str) -> None:
    acts: list[int] = st.session_state.get(f"stop_acts_{round_key}", [])
    if fault := st.session_state.pop("stop_fault", None):
        st.warning(plain(fault), icon=":material/error:")
    button(
        st,
        "Undo",
        "undo",
        _undo,
        round_key,
        acts,
        disabled=not acts,
        key=f"stop_undo_{round_key}",
    )


def _undo(round_key: str, acts: list[int]) -> None:
    try:
        resources.store().undo(number=acts.pop())
    except CucumberVisionError as error:
        st.session_state["stop_fault"] = str(error)
    resources.merge(round_key)
