"""Presses in Streamlit's pages: each is carried out once, and as it was meant."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import streamlit as st
from streamlit.runtime.state.safe_session_state import SafeSessionState

from cucumbervision_greenhouse.backend.words import Option, told_apart

_will_rerun = SafeSessionState.on_script_will_rerun


def label_options(key: str, names: Mapping[Option, str]) -> Callable[[Option], str]:
    """Return the labels of a choice that is drawn next: no two alike, and each meant for good.

    Streamlit knows what was chosen by its label only. The labels say how many stops or fruit there
    are, so that a browser may answer with one of before.

    Parameters
    ----------
    key : str
        Of the choice, in the session.
    names : mapping
        What is chosen, with its name.

    Returns
    -------
    callable
        The label of an option, as `format_func` of the choice.
    """
    labels = told_apart(names)
    meant = st.session_state.setdefault(f"{key}_labels", {})
    chosen = st.session_state.get(key)
    if chosen not in names and chosen in meant:
        st.session_state[key] = meant[chosen]
    meant.update({label: option for option, label in labels.items()})
    return lambda option: labels.get(option, str(option))


def finish_callbacks() -> None:
    """Let Streamlit interrupt a page only after the callbacks of what was pressed.

    Streamlit looks for a newer request before and within the callbacks of a run, and begins anew
    with that one: a press is lost, or done by half, if the page's own news come at that moment.
    """
    SafeSessionState.on_script_will_rerun = _uninterrupted  # type: ignore[assignment]


def _uninterrupted(state: SafeSessionState, *states: Any, **options: Any) -> None:
    runner: Any = getattr(state._yield_callback, "__self__", None)
    if not getattr(runner, "_execing", False):
        _will_rerun(state, *states, **options)
        return
    runner._execing = False  # it is not interrupted then
    try:
        _will_rerun(state, *states, **options)
    finally:
        runner._execing = True
