"""Presses in Streamlit's pages: each is carried out once, whatever else draws the page anew."""

from __future__ import annotations

from typing import Any

from streamlit.runtime.state.safe_session_state import SafeSessionState

_will_rerun = SafeSessionState.on_script_will_rerun


def finish_callbacks() -> None:
    """Let Streamlit interrupt a page only after the callbacks of what was pressed.

    Streamlit looks for a newer request before and within the callbacks of a run, and begins anew
    with that one: a press is lost, or done by half, if the page's own news come at that moment.
    """
    SafeSessionState.on_script_will_rerun = _uninterrupted  # type: ignore[assignment]


def _uninterrupted(state: SafeSessionState, *states: Any, **more: Any) -> None:
    runner: Any = getattr(state._yield_callback, "__self__", None)
    if not getattr(runner, "_execing", False):
        _will_rerun(state, *states, **more)
        return
    runner._execing = False  # it is not interrupted then
    try:
        _will_rerun(state, *states, **more)
    finally:
        runner._execing = True
