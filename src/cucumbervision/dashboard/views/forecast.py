"""Forecast: how many fruit will be in which class, what to pick today, and the work it takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.agronomy.picking import Span, pick_list, plan_work
from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.round_tables import class_name, day_name, forecast_chart

if TYPE_CHECKING:
    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.store.views import RoundView

__all__ = ["page"]


@page_elements.of_round
def page(one: RoundView) -> None:
    """Draw the page."""
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
    st.altair_chart(forecast_chart(found))
    house = found.house
    lines = []
    for day in found.days.tolist():
        line = {"Day": day_name(day)}
        for k in range(len(found.classes)):
            least = "" if found.complete[day, k] else "at least "
            count = Span(house.expected[day, k], house.low[day, k], house.high[day, k])
            line[class_name(found, k)] = f"{least}{_interval(count)}"
        lines.append(line)
    page_elements.table(lines)
    st.caption(
        "Growth is the crop profile's until fruit are linked between days. 'At least': fruit too "
        "small to be detected today are not counted."
    )


def _picks(found: Forecast) -> None:
    units, picks = resources.settings().units, pick_list(found)
    if not picks:
        st.info("No fruit is ready today.", icon=":material/shopping_basket:")
        return
    st.markdown(f"**{len(picks)} fruit are ready today**, in walking order")
    # A plain table prints whole, a scrolling one only what is seen.
    st.table(
        [
            {
                "Row": pick.fruit.row,
                "Side": pick.fruit.side,
                "At [m]": f"{pick.fruit.position_m:.2f}",
                "Length": units.text(pick.fruit.length_m),
                "Class": pick.name,
                "Probability": f"{100 * pick.ready:.0f} %",
                "Done": "☐",
            }
            for pick in picks
        ]
    )
    fruit = [pick.fruit.fruit_id for pick in picks]

    def mark_picked() -> None:
        resources.store().pick(fruit)

    with st.container(key="noprint"):
        mark, hint = st.columns([1, 2], vertical_alignment="center")
        page_elements.button(mark, "Mark all as picked", "shopping_basket", mark_picked)
        hint.caption("Print with the browser: Ctrl+P, or Share and Print on a tablet.")


def _work(found: Forecast) -> None:
    now = resources.settings()
    per_hour, per_row, per_crate = st.columns(3)
    resources.change_settings(
        fruit_per_hour=per_hour.number_input(
            "Fruit picked in an hour", 1.0, 5000.0, now.fruit_per_hour, 10.0
        ),
        minutes_per_row=per_row.number_input(
            "Minutes for each row", 0.0, 120.0, now.minutes_per_row, 0.5
        ),
        fruit_per_crate=per_crate.number_input("Fruit in a crate", 1, 500, now.fruit_per_crate),
    )
    lines = [
        {
            "Day": day_name(day.day),
            "Fruit": _interval(day.fruit),
            "Hours": _interval(day.hours, digits=1),
            **{f"Crates {name}": _interval(n) for name, n in day.crates.items()},
        }
        for day in plan_work(found, resources.settings().rates)
    ]
    page_elements.table(lines)
    st.caption("If every ready fruit is picked every day; hours for one person.")


def _interval(of: Span, digits: int = 0) -> str:
    return f"{of.expected:.{digits}f} ({of.low:.{digits}f} to {of.high:.{digits}f})"
