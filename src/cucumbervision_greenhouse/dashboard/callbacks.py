"""Labels of choices, which Streamlit identifies by their text alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import streamlit as st

from cucumbervision_greenhouse.backend.plain_text import Option, told_apart


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
