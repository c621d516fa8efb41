"""Callbacks of Streamlit's pages: each press acts once, on the object that was shown."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import streamlit as st
from streamlit.runtime.state.safe_session_state import SafeSessionState

from cucumbervision.errors import CucumberVisionError
from cucumbervision_greenhouse.backend.core_sentences import said
from cucumbervision_greenhouse.backend.plain_text import Option, sentence, told_apart

_will_rerun = SafeSessionState.on_script_will_rerun


def label_options(key: str, names: Mapping[Option, str]) -> Callable[[Option], str]:
    """Return the labels of a choice that is drawn next: unique, and never reused for another.

    Streamlit identifies a choice by its label alone. Labels contain numbers of stops or fruit, so a
    browser may answer with an earlier label.

    Parameters
    ----------
    key : str
        Key of the choice in the session.
    names : mapping
        The options with their names.

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
    """Let Streamlit interrupt a page only after the callbacks of a press.

    Streamlit checks for a newer request before and during the callbacks of a run, and then starts
    over with that request: a press would be lost or half done if news arrived at that moment.
    """
    SafeSessionState.on_script_will_rerun = _uninterrupted  # type: ignore[assignment]


def _uninterrupted(state: SafeSessionState, *states: Any, **options: Any) -> None:
    runner: Any = getattr(state._yield_callback, "__self__", None)
    if not getattr(runner, "_execing", False):
        _will_rerun(state, *states, **options)
        return
    runner._execing = False  # prevents an interruption
    try:
        _will_rerun(state, *states, **options)
    except CucumberVisionError as error:
        # Such as a full disk, or a fruit that another viewer deleted; pages say their own faults.
        st.toast(sentence(said(error)), icon=":material/error:", duration="long")
    finally:
        runner._execing = True
