"""Row map: where the fruit hang, by position and height."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.plain_text import plain
from cucumbervision.dashboard.round_tables import map_chart, map_lines

if TYPE_CHECKING:
    from cucumbervision.store.views import RoundView

__all__ = ["page"]

ROWS_AT_ONCE = 4


@page_elements.of_round
def page(one: RoundView) -> None:
    """Draw the page."""
    units = resources.settings().units
    lines = map_lines(resources.lists_of(one), units)
    if not lines:
        st.info(
            "No fruit of this round has a position yet. Enter row and position when capturing.",
            icon=":material/map:",
        )
        return
    by, where = st.columns([2, 3], vertical_alignment="bottom")
    colored = by.segmented_control(
        "Colour by", ["Class", "Length"], default="Class", key="color_by", required=True
    )
    rows = sorted({line["row"] for line in lines})
    chosen = where.multiselect("Rows and sides", rows, default=rows[:ROWS_AT_ONCE])
    if not chosen:
        st.info("Choose a row.", icon=":material/map:")
        return
    shown = [line for line in lines if line["row"] in chosen]
    for row in [row for row in rows if row in chosen]:
        st.markdown(f"**{plain(row)}**")
        here = [line for line in shown if line["row"] == row]
        st.altair_chart(map_chart(here, shown, units, by_length=colored == "Length"))
    st.caption(
        "One mark a fruit, a cross where it was picked; point at a mark or tap it for details. "
        "Heights are relative to the camera."
    )
