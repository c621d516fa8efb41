"""A press is carried out whole, whatever asks for the page to be drawn anew at that moment."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("streamlit")

from streamlit.runtime.scriptrunner_utils.script_requests import RerunData, ScriptRequests
from streamlit.runtime.state.safe_session_state import SafeSessionState
from streamlit.testing.v1 import AppTest

from cucumbervision_greenhouse.dashboard import callbacks

PATIENCE_S = 300.0


def _page() -> None:
    import streamlit as st

    def press() -> None:
        st.session_state["begun"] = st.session_state.get("begun", 0) + 1
        st.query_params["fruit"] = "second"
        st.session_state["pressed"] = st.session_state.get("pressed", 0) + 1

    st.button("Press", on_click=press)


@pytest.fixture
def whole(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "on_script_will_rerun"
    monkeypatch.setattr(SafeSessionState, name, getattr(SafeSessionState, name))  # put back later
    callbacks.finish_callbacks()


@pytest.fixture
def overtaken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let another request come in as soon as the run of a press was taken up."""
    take_up = ScriptRequests.on_scriptrunner_ready

    def and_another(requests: ScriptRequests) -> Any:
        taken = take_up(requests)
        states = taken._rerun_data and taken._rerun_data.widget_states
        if states and any(one.trigger_value for one in states.widgets):
            requests.request_rerun(RerunData(widget_states=type(states)()))
        return taken

    monkeypatch.setattr(ScriptRequests, "on_scriptrunner_ready", and_another)


@pytest.mark.usefixtures("whole", "overtaken")
def test_a_press_that_is_overtaken_is_carried_out_whole_and_once() -> None:
    page = AppTest.from_function(_page, default_timeout=PATIENCE_S).run()
    for presses in (1, 2):
        page.button[0].click().run()
        assert not page.exception
        assert page.session_state["begun"] == page.session_state["pressed"] == presses


def _full_disk() -> None:
    import streamlit as st

    from cucumbervision.errors import StoreError

    def press() -> None:
        raise StoreError("the disk is full", remedy="free some space")

    st.button("Press", on_click=press)
    st.write("whole")


@pytest.mark.usefixtures("whole")
def test_what_stops_a_press_is_said_and_leaves_the_page_whole() -> None:
    page = AppTest.from_function(_full_disk, default_timeout=PATIENCE_S).run()
    page.button[0].click().run()
    assert not page.exception
    assert "The disk is full; free some space" in page.toast[0].value
    assert page.markdown[0].value == "whole"


def _choice() -> None:
    import streamlit as st

    from cucumbervision_greenhouse.dashboard.callbacks import label_options

    st.session_state["stops"] = st.session_state.get("stops", 0) + 1  # more with every run
    names = dict.fromkeys(("a", "b", "c"), f"Round, {st.session_state['stops']} stops")
    st.selectbox("Round", list(names), format_func=label_options("round", names), key="round")


def test_what_is_called_alike_is_told_apart_and_a_name_of_before_is_understood() -> None:
    page = AppTest.from_function(_choice, default_timeout=PATIENCE_S).run()
    for key in ("c", "b", "a", "b"):
        page.selectbox[0].select(key).run()
        assert not page.exception
        assert page.session_state["round"] == page.selectbox[0].value == key
