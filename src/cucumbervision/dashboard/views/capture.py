"""Capture: the camera's picture, the quality of its depth, and one large button."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import streamlit as st

from cucumbervision.agronomy.grades import GradingTraits, grade
from cucumbervision.capture.frames import Stop
from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.fruit_view import as_data_url, picture, scale_bar
from cucumbervision.dashboard.measuring import TakenStop
from cucumbervision.dashboard.plain_text import plain
from cucumbervision.dashboard.round_tables import grade_name
from cucumbervision.dashboard.views.fruit import add_fruit, show_correction
from cucumbervision.measurement.result import Selector
from cucumbervision.pipeline.fields import si_values
from cucumbervision.pipeline.overlay import draw_overlay

if TYPE_CHECKING:
    from cucumbervision.dashboard.camera_feed import Preview
    from cucumbervision.dashboard.jobs import Job
    from cucumbervision.store.views import RoundView

__all__ = ["page"]

PREVIEW_PX = 960

INPUT_SIZES_PX = (320, 448, 640, 960, 1280)  # that are offered; a file may name others


@page_elements.of_round
def page(one: RoundView) -> None:
    """Draw the page."""
    left, right = page_elements.halves()
    with right:
        kind = _source()
        _place()
        take = {"type": "primary", "key": "take", "shortcut": "Enter"}
        page_elements.button(st, "Capture", "photo_camera", _take, one, kind, **take)
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


def _take(one: RoundView, kind: str) -> None:
    state, feed = st.session_state, resources.feed(kind)
    options = resources.settings().options
    stop = Stop(
        state["row"].strip() or None, state["side"], float(state["position_m"]), one.stops + 1
    )
    burst, store, measurer = options.reading.burst, resources.store(), resources.measurer()

    def work(job: Job) -> TakenStop:
        job.total = 2
        capture = feed.take(burst, stop)
        job.step()
        return measurer.take_stop(store, one.key, capture, options)

    page_elements.start_job("capture_job", "Measuring", work)
    state["position_m"] = round(float(state["position_m"]) + float(state["step_m"]), 2)


def _how() -> None:
    with st.expander("How to measure", icon=":material/tune:"):
        now = resources.settings()
        resources.change_settings(
            burst=st.slider("Frames fused to one capture", 1, 15, now.burst),
            confidence=st.slider(
                "Least confidence of a detection", 0.05, 0.95, now.confidence, 0.05
            ),
            input_sizes=tuple(
                st.multiselect(
                    "What the networks see, pixels (long side)",
                    sorted({*INPUT_SIZES_PX, *now.input_sizes}),
                    now.input_sizes,
                    placeholder="Their own size",
                    max_selections=2,
                    help="Larger sizes find smaller fruit and take longer; two are merged.",
                )
            ),
            selector=st.segmented_control(
                "Method chosen",
                list(Selector),
                format_func={Selector.BEST: "Best", Selector.PAPER: "As in the paper"}.__getitem__,
                default=now.selector,
                required=True,
            )
            or now.selector,
        )


def _preview(kind: str) -> None:
    seen = resources.feed(kind).preview()
    if seen.state == "absent":
        if kind == "camera" and not st.session_state.get("source_chosen"):
            st.session_state["no_camera"] = True
            st.rerun()
        _absent(kind, seen)
        return

    still = seen.state == "replay"  # it changes only with a capture, which draws the page anew

    @st.fragment(run_every=None if still else 0.5)
    def _live() -> None:
        preview = resources.feed(kind).preview()
        if preview.state == "absent" or (preview.state == "replay" and not still):
            st.rerun()
        if preview.capture is None:
            st.info("Opening …", icon=":material/hourglass:")
            return
        shown = preview.capture
        near = preview.quality.distance_m if preview.quality else None
        picture(
            f"preview_{kind}",
            {"live": as_data_url(shown.color, PREVIEW_PX)},
            (shown.width, shown.height),
            bar=scale_bar(shown.intrinsics, near, resources.settings().units),
            title="The camera's picture",
        )
        _quality(preview)

    _live()


def _absent(kind: str, preview: Preview) -> None:
    if kind == "replay":
        st.error(f"The replay cannot be shown. {plain(preview.message)}", icon=":material/error:")
        return
    st.warning(f"No camera was found. {plain(preview.message)}", icon=":material/videocam_off:")
    st.write("Connect a RealSense camera to a USB 3 port, or choose 'Replay' to try without one.")
    if st.button("Search for the camera again", icon=":material/refresh:"):
        resources.camera().retry()
        st.rerun()


def _quality(preview: Preview) -> None:
    if preview.quality is None or preview.capture is None:
        st.caption("Loading the next capture …")
        return
    quality, units = preview.quality, resources.settings().units
    depth, distance, advice = st.columns([1, 1, 2], vertical_alignment="center")
    depth.metric("Valid depth", f"{100 * quality.fill:.0f} %")
    distance.metric("Distance", units.text(quality.distance_m))
    colors: dict[str, Literal["green", "orange", "red"]] = {"good": "green", "none": "red"}
    color = colors.get(quality.verdict, "orange")
    advice.badge(quality.advice, color=color, width="stretch")
    state = "Replay" if preview.state == "replay" else "Live"
    simulated = ", simulated" if preview.capture.simulated else ""
    advice.caption(f"{state}: {plain(preview.capture.name)}{simulated}")


def _result(one: RoundView) -> TakenStop | None:
    if st.session_state.get("capture_job") is None:
        st.caption(f"{one.stops} stops in this round. Each capture's result is shown here.")
    job = page_elements.finished_job("capture_job")
    if job is None:
        return None
    if job.error:
        st.error(f"Nothing was captured. {plain(job.error)}", icon=":material/error:")
        return None
    taken: TakenStop = job.result
    if taken.note:
        st.warning(f"Saved, but not measured: {plain(taken.note)}", icon=":material/warning:")
    _lengths(one, taken)
    return taken


def _lengths(one: RoundView, taken: TakenStop) -> None:
    units, stop = resources.settings().units, taken.result.capture.stop
    st.markdown(
        f"**Row {plain(stop.row or '?')}, {plain(stop.side)}, {stop.position_m:.2f} m: saved**"
    )
    _, profile = resources.profile_of(one)
    lines = []
    for seen in taken.result.seen:
        fruit = seen.fruit
        least = "at least " if fruit.at_least else ""
        found = grade(GradingTraits.from_si(si_values(seen)), profile)
        lines.append(
            {
                "Fruit": seen.number,
                "Length": f"{least}{units.text(fruit.length.value_m)}"
                if fruit.length
                else "not measured",
                "Class": grade_name(found),
                "Method": fruit.method or fruit.reason,
                "Mask by": fruit.mask_source.words if fruit.mask_source else "no mask",
            }
        )
    if lines:
        page_elements.table(lines)
    elif not taken.note:
        st.info("No fruit was found in this capture.", icon=":material/search_off:")


def _picture(taken: TakenStop) -> None:
    capture = taken.result.capture
    drawn = draw_overlay(capture, taken.result.fruit)
    size = (capture.width, capture.height)
    tapped = picture(
        f"result_{taken.key}",
        {"measured": as_data_url(drawn)},
        size,
        tools=("point", "box"),
        title="The measured fruit; a tap or a box adds one that was not found",
    )
    if tapped.point or tapped.box:
        add_fruit(resources.store().stop(taken.key), capture, tapped.point, tapped.box)
    show_correction()
