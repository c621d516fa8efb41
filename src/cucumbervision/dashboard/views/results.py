"""Results: what a round came to, its fruit in a table, and each fruit by itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision.dashboard import charts, page_elements, resources
from cucumbervision.dashboard.round_tables import (
    RoundLists,
    grade_name,
    length_lines,
    method_lines,
    statistics,
)
from cucumbervision.dashboard.views import export
from cucumbervision.dashboard.views import fruit as fruit_page
from cucumbervision.store.views import DetectionFilter, Verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.store.views import DetectionView, RoundView

__all__ = ["page"]

LINES = 20
VERDICTS = {None: "", Verdict.ACCEPTED: "✓ accepted", Verdict.REJECTED: "✗ rejected"}


@dataclass(frozen=True)
class _Kept:
    """What the filters leave."""

    fruit: list[DetectionView]
    filtered: bool


def page() -> None:
    """Draw the page."""
    one = page_elements.pick_round()
    if one is None:
        st.info("There is no round yet. Press 'New round' to begin one.", icon=":material/flag:")
        return
    lists = resources.lists_of(one)
    known = {view.key for view in lists.fruit}
    if st.session_state.get("fruit") in known:
        fruit_page.show(one, lists, st.session_state["fruit"])
        return
    if not lists.fruit:
        _empty(one)
        return
    _statistics(lists)
    kept = _filters(lists)
    if not kept.fruit:
        st.info("No fruit passes these filters.", icon=":material/filter_alt_off:")
        return
    _charts(lists, kept.fruit)
    _table(lists, kept.fruit)
    _merge(one)
    with st.expander("Files of this round", icon=":material/download:"):
        export.show(one)


def _empty(one: RoundView) -> None:
    if resources.worker().unfinished():
        st.info("The first captures are being measured; their fruit appear here.")
    elif one.stops:
        st.info("No fruit was found at the stops of this round.", icon=":material/search_off:")
    else:
        st.info("This round has no stops yet. Go to 'Capture'.", icon=":material/photo_camera:")


def _statistics(lists: RoundLists) -> None:
    found, units = statistics(lists), resources.settings().units
    spread = f"± {units.text(found['sd_m'])}" if found["sd_m"] else None
    first, second, third, fourth, fifth = st.columns(5)
    first.metric(
        "Fruit",
        found["fruit"],
        f"seen {found['detections']} times",
        delta_color="off",
        delta_arrow="off",
    )
    second.metric("Measured", found["measured"])
    third.metric(
        "Mean length", units.text(found["mean_m"]), spread, delta_color="off", delta_arrow="off"
    )
    fourth.metric("Picked", found["picked"])
    fifth.metric("Rejected", found["rejected"])


def _filters(lists: RoundLists) -> _Kept:
    units = resources.settings().units
    with st.expander("Filters", icon=":material/filter_alt:"):
        row, named, method, verdict = st.columns(4)
        rows = sorted({view.row for view in lists.fruit if view.row})
        chosen_row = row.selectbox("Row", [None, *rows], format_func=lambda x: x or "all")
        names = sorted({grade_name(found) for found in lists.grades.values()})
        chosen_name = named.selectbox("Class", [None, *names], format_func=lambda x: x or "all")
        methods = sorted({view.record.method for view in lists.fruit if view.record.method})
        chosen_method = method.selectbox(
            "Method", [None, *methods], format_func=lambda x: x or "all"
        )
        chosen_verdict = verdict.selectbox(
            "Checked",
            [None, Verdict.ACCEPTED, Verdict.REJECTED],
            format_func=lambda x: str(x) if x else "all",
        )
        highest = 20.0 if units.name == "in" else 50.0
        low, high = st.slider(f"Length [{units.name}]", 0.0, highest, (0.0, highest), 0.5)
        limited = (low, high) != (0.0, highest)
        only = DetectionFilter(
            row=chosen_row,
            method=chosen_method,
            verdict=chosen_verdict,
            min_length_m=units.metres(low) if limited else None,
            max_length_m=units.metres(high) if limited else None,
        )
    fruit = [
        view
        for view in lists.fruit
        if only.keeps(view)
        and (chosen_name is None or grade_name(lists.grades[view.key]) == chosen_name)
    ]
    return _Kept(fruit, len(fruit) < len(lists.fruit))


def _charts(lists: RoundLists, fruit: Sequence[DetectionView]) -> None:
    units = resources.settings().units
    lengths, methods = st.columns(2)
    if lines := length_lines(fruit, lists.grades, units):
        with lengths:
            st.markdown("**Lengths**: line at the mean, band of one standard deviation")
            drawn = {str(x["class"]) for x in lines}
            named = [name for name in page_elements.CLASSES if name in drawn]
            extra = sorted(drawn - set(named))
            st.altair_chart(charts.histogram(lines, [*named, *extra], units))
    if lines := method_lines(lists, {view.key for view in fruit}, units):
        with methods:
            st.markdown("**What each method reads**: middle half in the box, lines to the ends")
            st.altair_chart(charts.method_chart(lines, units))


def _table(lists: RoundLists, fruit: Sequence[DetectionView]) -> None:
    units = resources.settings().units
    pages = -(-len(fruit) // LINES)
    number = min(int(st.session_state.get("list_page", 1)), pages)
    shown = fruit[(number - 1) * LINES : number * LINES]
    st.markdown(f"**{len(fruit)} fruit**: tick one to look at it")
    lines = [_line(lists, view) for view in shown]
    chosen = st.dataframe(
        lines,
        hide_index=True,
        row_height=64,
        height=min(len(lines), 10) * 64 + 40,
        on_select="rerun",
        selection_mode="single-row",
        key=f"table_{number}_{len(fruit)}",
        column_config={
            "Picture": st.column_config.ImageColumn("", width="small"),
            "Length": st.column_config.NumberColumn(
                f"Length [{units.name}]", format=f"%.{units.digits}f"
            ),
        },
    )
    if pages > 1:
        st.session_state["list_page"] = number
        st.number_input(f"Page of {pages}", 1, pages, key="list_page")
    if picked := chosen["selection"]["rows"]:
        st.session_state["fruit"] = shown[picked[0]].key
        st.rerun()


def _merge(one: RoundView) -> None:
    merge, hint = st.columns([2, 3], vertical_alignment="center")
    merge.button(
        "Merge views of the same fruit",
        icon=":material/join:",
        width="stretch",
        on_click=resources.merge,
        args=(one.key,),
    )
    hint.caption("Fruit that neighbouring stops both show then count once; what you did stands.")
    job = next(iter(resources.worker().unfinished()), None)
    if job is not resources.prepare():  # which the frame of all pages shows
        page_elements.progress(job)


def _line(lists: RoundLists, view: DetectionView) -> dict[str, Any]:
    units, record = resources.settings().units, view.record
    low, high = units.value(record.interval_low_m), units.value(record.interval_high_m)
    return {
        "Picture": page_elements.thumbnail_of(view),
        "Length": units.value(record.length_m),
        "90 %": f"{low:.1f} to {high:.1f}" if low and high else "–",
        "Class": grade_name(lists.grades[view.key]),
        "Row": f"{view.row or '?'} {view.side or ''}",
        "At [m]": None if view.along_m is None else round(view.along_m, 2),
        "Method": record.method or record.reason,
        "Kind": record.length_kind or "–",
        "Views": view.views,
        "Checked": VERDICTS[view.verdict] + (", corrected" if view.corrected else ""),
        "Remarks": record.flags.replace("-", " "),
    }
