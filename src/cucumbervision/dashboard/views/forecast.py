"""Forecast: how many fruit will be in which class, what to pick today, and the work it takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.agronomy.picking import pick_list, plan_work
from cucumbervision.dashboard import charts, page_elements, resources
from cucumbervision.dashboard.charts import class_name, day_name

if TYPE_CHECKING:
    from cucumbervision.agronomy.forecast import Forecast

__all__ = ["page"]


def page() -> None:
    """Draw the page."""
    one = page_elements.pick_round()
    if one is None:
        st.info("There is no round yet. Press 'New round' to begin one.", icon=":material/flag:")
        return
    found = resources.forecast_of(one)
    if not found.fruit:
        st.info(
            "Nothing to forecast: no fruit of this round is measured and still on the plant.",
            icon=":material/calendar_month:",
        )
        return
    days, picks, work = st.tabs(["Next days", "Pick today", "Work and crates"])
    with days:
        _days(found)
    with picks:
        _picks(found)
    with work:
        _work(found)


def _days(found: Forecast) -> None:
    st.markdown("**Fruit in each class if nothing is picked**, with 80 % intervals")
    st.altair_chart(charts.forecast_chart(found))
    lines = []
    for day in found.days.tolist():
        line: dict[str, str] = {"Day": day_name(day)}
        for k in range(len(found.classes)):
            expected, low, high = (
                getattr(found.house, end)[day, k] for end in ("expected", "low", "high")
            )
            least = "" if found.complete[day, k] else "at least "
            line[class_name(found, k)] = f"{least}{expected:.0f} ({low:.0f} to {high:.0f})"
        lines.append(line)
    st.dataframe(lines, hide_index=True, row_height=40)
    st.caption(
        "Growth is the crop profile's own figure until fruit are linked between days. 'At least': "
        "fruit too small to be seen today come on top."
    )


def _picks(found: Forecast) -> None:
    units = resources.settings().units
    picks = pick_list(found)
    if not picks:
        st.info("No fruit is ready today.", icon=":material/shopping_basket:")
        return
    st.markdown(f"**{len(picks)} fruit are ready today**, in walking order")
    lines = [
        {
            "Row": pick.fruit.row,
            "Side": pick.fruit.side,
            "At [m]": f"{pick.fruit.position_m:.2f}",
            "Length": units.text(pick.fruit.length_m),
            "Class": pick.name,
            "Sure": f"{100 * pick.ready:.0f} %",
            "Done": "☐",
        }
        for pick in picks
    ]
    # A plain table prints whole, a scrolling one only what is seen.
    st.table(lines)
    with st.container(key="noprint"):
        keys = [pick.fruit.fruit_id for pick in picks]

        def pick() -> None:
            resources.store().pick(keys)

        mark, hint = st.columns([1, 2], vertical_alignment="center")
        mark.button(
            "Mark all as picked",
            icon=":material/shopping_basket:",
            width="stretch",
            on_click=pick,
        )
        hint.caption("Print with the browser: Ctrl+P, or Share and Print on a tablet.")


def _work(found: Forecast) -> None:
    now = resources.settings()
    per_hour, per_row, per_crate = st.columns(3)
    rate = per_hour.number_input("Fruit picked in an hour", 1.0, 5000.0, now.fruit_per_hour, 10.0)
    minutes = per_row.number_input("Minutes for each row", 0.0, 120.0, now.minutes_per_row, 0.5)
    crate = per_crate.number_input("Fruit in a crate", 1, 500, now.fruit_per_crate)
    chosen = now.model_copy(
        update={
            "fruit_per_hour": float(rate),
            "minutes_per_row": float(minutes),
            "fruit_per_crate": int(crate),
        }
    )
    if chosen != now:
        resources.save_settings(chosen)
    lines = []
    for day in plan_work(found, chosen.rates):
        line = {
            "Day": day_name(day.day),
            "Fruit": f"{day.fruit.expected:.0f} ({day.fruit.low:.0f} to {day.fruit.high:.0f})",
            "Hours": f"{day.hours.expected:.1f} ({day.hours.low:.1f} to {day.hours.high:.1f})",
        }
        for name, crates in day.crates.items():
            line[f"Crates {name}"] = (
                f"{crates.expected:.0f} ({crates.low:.0f} to {crates.high:.0f})"
            )
        lines.append(line)
    st.dataframe(lines, hide_index=True, row_height=40)
    st.caption("If every ready fruit is picked every day; hours for one person.")
