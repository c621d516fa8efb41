"""Forecast: how many fruit will be in which class, what to pick today, and the work it takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.agronomy.picking import pick_list, plan_work
from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard import round_tables as charts
from cucumbervision.dashboard.round_tables import class_name, day_name

if TYPE_CHECKING:
    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.agronomy.picking import Span
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
    st.altair_chart(charts.forecast_chart(found))
    house = found.house
    lines = []
    for day in found.days.tolist():
        line = {"Day": day_name(day)}
        for k in range(len(found.classes)):
            least = "" if found.complete[day, k] else "at least "
            expected, low, high = (
                float(values[day, k]) for values in (house.expected, house.low, house.high)
            )
            line[class_name(found, k)] = f"{least}{_interval(expected, low, high)}"
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
        mark.button(
            "Mark all as picked",
            icon=":material/shopping_basket:",
            width="stretch",
            on_click=mark_picked,
        )
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
            "Fruit": _estimate(day.fruit),
            "Hours": _estimate(day.hours, digits=1),
            **{f"Crates {name}": _estimate(crates) for name, crates in day.crates.items()},
        }
        for day in plan_work(found, resources.settings().rates)
    ]
    page_elements.table(lines)
    st.caption("If every ready fruit is picked every day; hours for one person.")


def _estimate(of: Span, digits: int = 0) -> str:
    return _interval(of.expected, of.low, of.high, digits)


def _interval(expected: float, low: float, high: float, digits: int = 0) -> str:
    return f"{expected:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"
