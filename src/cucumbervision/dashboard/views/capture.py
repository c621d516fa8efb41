"""Capture: what the camera sees, how good its depth is, and one large button."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import streamlit as st

from cucumbervision.agronomy.grades import GradingTraits, grade
from cucumbervision.capture.frames import Stop
from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.fruit_view import as_data_url, picture, scale_bar
from cucumbervision.dashboard.jobs import JobState
from cucumbervision.dashboard.measuring import TakenStop
from cucumbervision.dashboard.round_tables import grade_name
from cucumbervision.measurement.selector import Selector
from cucumbervision.pipeline.overlay import draw_overlay

if TYPE_CHECKING:
    from cucumbervision.dashboard.camera_feed import Look
    from cucumbervision.dashboard.jobs import Job
    from cucumbervision.store.views import RoundView

__all__ = ["page"]

VERDICT_COLORS: dict[str, Literal["green", "orange", "red"]] = {
    "good": "green",
    "too-near": "orange",
    "too-far": "orange",
    "poor": "orange",
}
PREVIEW_PX = 960


def page() -> None:
    """Draw the page."""
    one = page_elements.pick_round()
    if one is None:
        st.info("Begin a round first: press 'New round'.", icon=":material/flag:")
        return
    left, right = page_elements.halves()
    with right:
        kind = _source()
        _place()
        _button(one, kind)
        taken = _result(one)
        _how()
    with left:
        _preview(kind)
        if taken is not None:
            _picture(taken)


def _source() -> str:
    state = st.session_state
    if state.pop("no_camera", False):
        state["source"] = "replay"
        st.info("No camera was found, so the replay is shown.", icon=":material/videocam_off:")
    state.setdefault("source", "replay" if resources.replay_named() else "camera")
    chosen = st.segmented_control(
        "Pictures from",
        ["camera", "replay"],
        format_func={"camera": "Camera", "replay": "Replay"}.__getitem__,
        key="source",
        required=True,
        width="stretch",
        on_change=_source_chosen,
    )
    return chosen or "replay"


def _source_chosen() -> None:
    st.session_state["source_chosen"] = True
    resources.camera().retry()


def _place() -> None:
    for name, value in {"row": "1", "side": "left", "position_m": 0.0, "step_m": 0.4}.items():
        st.session_state.setdefault(name, value)
    row, side = st.columns(2)
    row.text_input("Row", key="row")
    side.segmented_control(
        "Side", ["left", "right"], format_func=str.capitalize, key="side", required=True
    )
    position, step = st.columns(2)
    position.number_input("Position [m]", min_value=0.0, step=0.1, format="%.2f", key="position_m")
    step.number_input(
        "Step [m]", min_value=0.0, max_value=5.0, step=0.1, format="%.2f", key="step_m"
    )


def _button(one: RoundView, kind: str) -> None:
    st.button(
        "Capture",
        icon=":material/photo_camera:",
        type="primary",
        width="stretch",
        key="take",
        shortcut="Enter",
        on_click=_take,
        args=(one, kind),
    )


def _take(one: RoundView, kind: str) -> None:
    state, options, feed = st.session_state, resources.options(), resources.feed(kind)
    stop = Stop(
        state["row"].strip() or None, state["side"], float(state["position_m"]), one.stops + 1
    )
    burst, store, measurer = options.reading.burst, resources.store(), resources.measurer()

    def work(job: Job) -> TakenStop:
        job.total = 2
        capture = feed.take(burst, stop)
        job.step()
        return measurer.take_stop(store, one.key, capture, options)

    state["job"] = resources.worker().submit("Measuring", work).number
    state["position_m"] = round(float(state["position_m"]) + float(state["step_m"]), 2)


def _how() -> None:
    with st.expander("How to measure", icon=":material/tune:"):
        now = resources.settings()
        burst = st.slider("Frames fused to one capture", 1, 15, now.burst)
        confidence = st.slider(
            "Confidence of a detection, at least", 0.05, 0.95, now.confidence, 0.05
        )
        selector = st.segmented_control(
            "Method chosen",
            list(Selector),
            format_func={Selector.BEST: "Best", Selector.PAPER: "As in the paper"}.__getitem__,
            default=now.selector,
            required=True,
        )
        chosen = now.model_copy(
            update={"burst": burst, "confidence": confidence, "selector": selector or now.selector}
        )
        if chosen != now:
            resources.save_settings(chosen)


def _preview(kind: str) -> None:
    seen = resources.feed(kind).look()
    if seen.state == "absent":
        if kind == "camera" and not st.session_state.get("source_chosen"):
            st.session_state["no_camera"] = True
            st.rerun()
        _absent(kind, seen)
        return

    still = seen.state == "replay"  # it changes only with a capture, which draws the page anew

    @st.fragment(run_every=None if still else 0.5)
    def _live() -> None:
        look = resources.feed(kind).look()
        if look.state == "absent" or (look.state == "replay" and not still):
            st.rerun()
        if look.capture is None:
            st.info("Opening …", icon=":material/hourglass:")
            return
        shown = look.capture
        near = look.health.distance_m if look.health else None
        picture(
            f"preview_{kind}",
            {"live": as_data_url(shown.color, PREVIEW_PX)},
            (shown.width, shown.height),
            bar=scale_bar(shown.intrinsics, near, resources.settings().units),
            title="What the camera sees",
        )
        _health(look)

    _live()


def _absent(kind: str, look: Look) -> None:
    if kind == "replay":
        st.error(f"The replay cannot be shown. {look.message}", icon=":material/error:")
        return
    st.warning(f"No camera was found. {look.message}", icon=":material/videocam_off:")
    st.write("Connect a RealSense camera to a USB 3 port, or choose 'Replay' to try without one.")
    if st.button("Look for the camera again", icon=":material/refresh:"):
        resources.camera().retry()
        st.rerun()


def _health(look: Look) -> None:
    if look.health is None or look.capture is None:
        st.caption("Turning to the next capture …")
        return
    health, units = look.health, resources.settings().units
    depth, distance, advice = st.columns([1, 1, 2], vertical_alignment="center")
    depth.metric("Depth filled", f"{100 * health.fill:.0f} %")
    distance.metric("Distance", units.text(health.distance_m))
    color = VERDICT_COLORS[health.verdict]
    advice.badge(health.advice, color=color, width="stretch")
    said = "Replay" if look.state == "replay" else "Live"
    drawn = ", simulated" if look.capture.simulated else ""
    advice.caption(f"{said}: {look.capture.name}{drawn}")


def _result(one: RoundView) -> TakenStop | None:
    job = resources.worker().get(st.session_state.get("job"))
    if job is None:
        st.caption(f"{one.stops} stops in this round. What you capture is shown here.")
        return None
    if not job.finished.is_set():
        page_elements.progress(job)
        return None
    if job.state is JobState.FAILED:
        st.error(f"Nothing was captured. {job.error}", icon=":material/error:")
        return None
    taken: TakenStop = job.result
    if taken.note:
        st.warning(f"Saved, but not measured: {taken.note}", icon=":material/warning:")
    _lengths(one, taken)
    return taken


def _lengths(one: RoundView, taken: TakenStop) -> None:
    units, stop = resources.settings().units, taken.result.capture.stop
    st.markdown(f"**Row {stop.row or '?'}, {stop.side}, {stop.position_m:.2f} m: saved**")
    lines = []
    for row, fruit in zip(taken.result.rows(), taken.result.fruit, strict=True):
        found = grade(GradingTraits.from_row(row), resources.profile(one))
        lines.append(
            {
                "Fruit": row["fruit"],
                "Length": units.text(fruit.length.value_m) if fruit.length else "not measured",
                "Class": grade_name(found),
                "Method": fruit.method or fruit.reason,
                "Mask by": fruit.mask_source.words if fruit.mask_source else "no mask",
            }
        )
    if lines:
        st.dataframe(lines, hide_index=True, row_height=40)
    elif not taken.note:
        st.info("No fruit was found in this capture.", icon=":material/search_off:")


def _picture(taken: TakenStop) -> None:
    capture = taken.result.capture
    drawn = draw_overlay(capture, taken.result.fruit)
    size = (capture.width, capture.height)
    picture("result", {"measured": as_data_url(drawn)}, size, title="What was measured")
