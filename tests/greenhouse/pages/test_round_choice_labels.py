"""Choices whose names are alike, or change."""

from __future__ import annotations

import pytest

pytest.importorskip("streamlit")

from streamlit.testing.v1 import AppTest

PATIENCE_S = 300.0


def _choice() -> None:
    import streamlit as st

    from cucumbervision_greenhouse.pages.round_choice import label_options

    st.session_state["stops"] = st.session_state.get("stops", 0) + 1  # more with every run
    names = dict.fromkeys(("a", "b", "c"), f"Round, {st.session_state['stops']} stops")
    st.selectbox("Round", list(names), format_func=label_options("round", names), key="round")


def test_what_is_called_alike_is_told_apart_and_a_name_of_before_is_understood() -> None:
    page = AppTest.from_function(_choice, default_timeout=PATIENCE_S).run()
    for key in ("c", "b", "a", "b"):
        page.selectbox[0].select(key).run()
        assert not page.exception
        assert page.session_state["round"] == page.selectbox[0].value == key
