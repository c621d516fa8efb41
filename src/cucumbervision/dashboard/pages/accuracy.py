"""Accuracy: lengths measured by hand beside the program's."""

from __future__ import annotations

import streamlit as st

from cucumbervision.dashboard import parts

__all__ = ["page"]


def page() -> None:
    """Draw the page."""
    one = parts.pick_round()
    if one is None:
        st.info("There is no round yet. Press 'New round' to begin one.", icon=":material/flag:")
