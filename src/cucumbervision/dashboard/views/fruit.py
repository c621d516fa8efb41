"""One fruit: its picture with what was measured, depth, cloud, ruler; accept, reject, correct."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.fruit_view import (
    CLOUD_HEIGHT_PX,
    as_data_url,
    depth_picture,
    fruit_layers,
    picture,
    point_cloud,
    ruler_m,
    scale_bar,
)
from cucumbervision.dashboard.jobs import JobState
from cucumbervision.dashboard.measuring import stored_capture
from cucumbervision.dashboard.round_tables import RoundLists, figure_lines, grade_name
from cucumbervision.errors import CucumberVisionError
from cucumbervision.perception.instances import MaskSource
from cucumbervision.store.views import Verdict

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.dashboard.jobs import Job
    from cucumbervision.store.records import DetectionRecord, MethodRecord
    from cucumbervision.store.views import DetectionDetail, RoundView

__all__ = ["show"]


def show(one: RoundView, lists: RoundLists, key: str) -> None:
    """Draw a fruit in place of the list."""
    detail = resources.fruit_detail(one, key)
    _head(lists, key)
    left, right = page_elements.halves()
    with right:
        _figures(lists, detail)
        _verdict(one, detail)
    with left:
        _pictures(one, detail)
    _methods(detail)


def _head(lists: RoundLists, key: str) -> None:
    keys = [view.key for view in lists.fruit]
    at = keys.index(key)
    back, before, after = st.columns([2, 1, 1])

    def go(to: str | None) -> None:
        st.session_state["fruit"] = to
        st.session_state.pop("ruler", None)

    back.button(
        "All fruit", icon=":material/arrow_back:", width="stretch", on_click=go, args=(None,)
    )
    before.button(
        "Before",
        icon=":material/chevron_left:",
        width="stretch",
        disabled=at == 0,
        on_click=go,
        args=(keys[max(at - 1, 0)],),
        shortcut="Left",
    )
    after.button(
        "Next",
        icon=":material/chevron_right:",
        width="stretch",
        disabled=at == len(keys) - 1,
        on_click=go,
        args=(keys[min(at + 1, len(keys) - 1)],),
        shortcut="Right",
    )


def _figures(lists: RoundLists, detail: DetectionDetail) -> None:
    record, units, found = (
        detail.view.record,
        resources.settings().units,
        lists.grades[detail.view.key],
    )
    between = None
    if record.interval_low_m and record.interval_high_m:
        low, high = units.text(record.interval_low_m), units.text(record.interval_high_m)
        between = f"90 %: {low} to {high}"
    st.metric(
        f"Length ({record.length_kind or 'not measured'})",
        units.text(record.length_m),
        between,
        delta_color="off",
        delta_arrow="off",
    )
    st.markdown(f"**{grade_name(found).capitalize()}**")
    for rule in found.rules:
        st.caption(rule)
    traits = {
        "Thickest": None if not record.diameter_max_m else f"{1000 * record.diameter_max_m:.0f} mm",
        "Weight, about": None if not found.mass_g else f"{found.mass_g:.0f} g",
        "Away from the camera": units.text(record.distance_m),
        "Mask by": record.mask_source and MaskSource(record.mask_source).words,
        "Hidden": None if record.hidden_share is None else f"{100 * record.hidden_share:.0f} %",
    }
    said = [f"{name}: {value}" for name, value in traits.items() if value]
    st.write(" · ".join(said))
    if record.flags:
        st.caption(f"Remarks: {record.flags.replace('-', ' ')}")
    with st.expander("All figures", icon=":material/list:"):
        st.dataframe(figure_lines(record), hide_index=True)


def _verdict(one: RoundView, detail: DetectionDetail) -> None:
    key, now, store = detail.view.key, detail.view.verdict, resources.store()
    is_picked = detail.view.picked_s is not None

    def judge(verdict: Verdict | None) -> None:
        store.set_verdict([key], verdict)

    def pick() -> None:
        store.unpick([key]) if is_picked else store.pick([key])

    accept, reject = st.columns(2)
    for place, verdict, name, icon in (
        (accept, Verdict.ACCEPTED, "Accept", ":material/check:"),
        (reject, Verdict.REJECTED, "Reject", ":material/close:"),
    ):
        place.button(
            f"{name}ed" if now is verdict else name,
            icon=icon,
            width="stretch",
            type="primary" if now is verdict else "secondary",
            on_click=judge,
            args=(None if now is verdict else verdict,),
        )
    picked, undo = st.columns(2)
    picked.button(
        "Not picked" if is_picked else "Picked",
        icon=":material/shopping_basket:",
        width="stretch",
        on_click=pick,
    )
    undo.button("Undo", icon=":material/undo:", width="stretch", on_click=_undo, args=(one,))
    if said := st.session_state.pop("undo_fault", None):
        st.info(said)


def _undo(one: RoundView) -> None:
    try:
        resources.store().undo(one.key)
    except CucumberVisionError as error:
        st.session_state["undo_fault"] = str(error)


def _pictures(one: RoundView, detail: DetectionDetail) -> None:
    try:
        capture = _capture(detail)
    except CucumberVisionError as error:
        st.warning(str(error), icon=":material/broken_image:")
        return
    seen, turned = st.tabs(["Picture", "3D"])
    with seen:
        _picture(one, detail, capture)
    with turned:
        deck = point_cloud(capture, detail.view.record)
        if deck is None:
            st.info("There is no depth on this fruit to show in 3D.")
        else:
            with st.container(key="point_cloud"):
                st.pydeck_chart(deck, height=CLOUD_HEIGHT_PX)
            st.caption(
                "Depth points (surroundings pale), rings of the fitted tube in blue, its axis in "
                "white; the bar is 5 cm long. Drag to turn, pinch or wheel to zoom."
            )


@st.cache_resource(show_spinner=False, max_entries=6)
def _loaded(key: str, sha256: str, _detail: object) -> Capture:
    del key, sha256
    return stored_capture(resources.store().images, _detail.capture, _detail.stop)  # type: ignore[attr-defined]


def _capture(detail: DetectionDetail) -> Capture:
    color = detail.capture.color
    return _loaded(detail.view.stop_key, color.sha256 if color else "", detail)


def _picture(one: RoundView, detail: DetectionDetail, capture: Capture) -> None:
    depth, words = depth_picture(capture.depth_m)
    record, units = detail.view.record, resources.settings().units
    ruler = st.session_state.get("ruler")
    said = picture(
        f"fruit_{detail.view.key}",
        {"Colour": as_data_url(capture.color), "Depth": as_data_url(depth)},
        (capture.width, capture.height),
        layers=fruit_layers(record, capture.intrinsics),
        bar=scale_bar(capture.intrinsics, record.distance_m, units),
        tools=("ruler", "point", "box"),
        ruler_text=ruler or "",
        title=f"Fruit {record.number} of {detail.view.capture}",
    )
    drawn = ", simulated capture" if capture.simulated else ""
    st.caption(f"{detail.view.capture}{drawn}. Depth: {words}.")
    if said.ruler:
        x1, y1, x2, y2 = (float(x) for x in said.ruler)
        length_m = ruler_m(capture, (x1, y1), (x2, y2))
        text = units.text(length_m) if length_m is not None else "no depth there"
        st.session_state["ruler"] = text
        st.rerun()
    if ruler:
        st.markdown(f"Ruler: **{ruler}** straight")
    if said.point or said.box:
        _correct(one, detail, capture, said.point, said.box)
    _correction()


def _correct(
    one: RoundView,
    detail: DetectionDetail,
    capture: Capture,
    point: list[float] | None,
    box: list[float] | None,
) -> None:
    options, measurer, store = resources.options(), resources.measurer(), resources.store()
    del one

    def work(job: Job) -> int:
        job.total = 2
        mask: NDArray[np.bool_]
        if point:
            mask = measurer.mask_from_click(capture, (float(point[0]), float(point[1])))
        else:
            x1, y1, x2, y2 = (float(value) for value in box or ())
            mask = measurer.mask_from_box(capture, (x1, y1, x2, y2))
        job.step()
        return measurer.correct(store, detail, mask, options)

    st.session_state["correction"] = resources.worker().submit("Drawing the outline", work).number


def _correction() -> None:
    job = resources.worker().get(st.session_state.get("correction"))
    if job is None:
        return
    if not job.finished.is_set():
        page_elements.progress(job)
    elif job.state is JobState.FAILED:
        st.warning(job.error, icon=":material/error:")
        st.session_state.pop("correction")
    else:
        st.success("Measured anew with this outline. 'Undo' brings the first one back.")
        st.session_state.pop("correction")


def _said(method: MethodRecord, record: DetectionRecord) -> str:
    if method.method == record.method:
        return "chosen"
    return "" if method.reason == "ok" else method.reason.replace("-", " ")


def _methods(detail: DetectionDetail) -> None:
    units, record = resources.settings().units, detail.view.record
    lines = []
    for method in record.methods:
        own = method.measured_by is None
        lines.append(
            {
                "Method": method.method,
                "Length": units.text(method.length_m),
                "Kind": method.kind or "–",
                "Thread": units.text(method.thread_m),
                "Centreline": units.text(method.centreline_m),
                "Chord": units.text(method.chord_m),
                "Said": _said(method, record),
                "Instead": "" if own else f"{method.measured_by} stood in",
            }
        )
    with st.expander("All methods", expanded=True, icon=":material/straighten:"):
        st.dataframe(lines, hide_index=True, row_height=40)
        if record.fallback:
            st.caption(f"Tried before: {record.fallback}")
    if detail.log:
        with st.expander("What was done by hand", icon=":material/history:"):
            for action in detail.log:
                undone = " (taken back)" if action.undone else ""
                st.write(f"{action.kind}{undone}")
