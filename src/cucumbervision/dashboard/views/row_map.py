"""Row map: where the fruit hang, by position and height."""

from __future__ import annotations

import streamlit as st

from cucumbervision.dashboard import charts, page_elements, resources
from cucumbervision.dashboard.round_tables import map_lines

__all__ = ["page"]

ROWS_AT_ONCE = 4


def page() -> None:
    """Draw the page."""
    one = page_elements.pick_round()
    if one is None:
        st.info("There is no round yet. Press 'New round' to begin one.", icon=":material/flag:")
        return
    lists, units = resources.lists_of(one), resources.settings().units
    lines = map_lines(lists.fruit, lists.grades, units)
    if not lines:
        st.info(
            "No fruit of this round has a position yet. Give row and position when capturing.",
            icon=":material/map:",
        )
        return
    by, where = st.columns([2, 3], vertical_alignment="bottom")
    colored = by.segmented_control(
        "Colour by", ["Class", "Length"], default="Class", key="color_by", required=True
    )
    rows = sorted({line["row"] for line in lines})
    shown = where.multiselect("Rows and sides", rows, default=rows[:ROWS_AT_ONCE])
    lines = [line for line in lines if line["row"] in shown]
    if not lines:
        st.info("Choose a row.", icon=":material/map:")
        return
    named = [name for name in page_elements.CLASSES if any(line["class"] == name for line in lines)]
    others = sorted({str(line["class"]) for line in lines} - set(named))
    for row in [row for row in rows if row in shown]:
        st.markdown(f"**{row}**")
        here = [line for line in lines if line["row"] == row]
        by_length = colored == "Length"
        st.altair_chart(charts.map_chart(here, lines, [*named, *others], units, by_length))
    st.caption(
        "One mark a fruit, a cross where it was picked; point at one or tap it to read more. "
        "Heights count from the camera."
    )
