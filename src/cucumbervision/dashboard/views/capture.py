"""Capture: the camera's picture and depth, and one large button whose presses are kept at once."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Literal

import streamlit as st

from cucumbervision.agronomy.grades import grade
from cucumbervision.capture.frames import Stop
from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.fruit_view import (
    as_data_url,
    component,
    depth_picture,
    picture,
    scale_bar,
    stop_layers,
)
from cucumbervision.dashboard.settings import EXPOSURE_US, PRESETS
from cucumbervision.dashboard.shutter import Press
from cucumbervision.dashboard.views.fruit import add_fruit, show_correction
from cucumbervision.dashboard.views.stops import CORRECTING, change_stop
from cucumbervision.dashboard.words import counted, grade_name, length_words, plain, stop_name
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import Selector
from cucumbervision.rounds.demonstration import DEMONSTRATION, is_demonstration
from cucumbervision.rounds.stop_records import stored_capture
from cucumbervision.rounds.walking import NextPlace, next_place, sides_of, unless_taken
from cucumbervision.store.views import DetectionFilter

if TYPE_CHECKING:
    from cucumbervision.dashboard.camera_feed import Preview
    from cucumbervision.store.views import RoundView, StopView

_PREVIEW_PX = 800
_PANEL_S = 1.0  # how often what waits is looked at
_SHOWN_PRESSES = 10  # presses of which it is said that they failed

_INPUT_SIZES_PX = (320, 448, 640, 960, 1280)  # that are offered; a file may name others


@page_elements.of_round
def page(one: RoundView) -> None:
    """Draw the page."""
    left, right = page_elements.halves()
    # Each part has its place whatever is drawn in it: a part that draws itself anew by the second
    # must never find that the page has moved, or the browser gives the page up.
    with right:
        source, notice, panel, camera, how = (st.container() for _ in range(5))
    with left:
        preview = st.container()
    with source:
        kind = _source()
    simulated = _preview_is_simulated(kind)
    home = DEMONSTRATION if simulated else one.key
    if simulated and not is_demonstration(one.key):
        notice.info(
            "These pictures are simulated. Captures of them go into the round "
            "'Demonstration', never into yours.",
            icon=":material/draw:",
        )
    with panel:
        _panel(one, home, kind)
    if kind == "camera":
        with camera:
            _camera()
    with how:
        _how()
    with preview:
        _preview(kind)
    _last_stop(one, home)


def _source() -> str:
    state, notice = st.session_state, st.container()
    if state.pop("no_camera", False):
        state["source"] = "replay"
        notice.info("No camera was found, so the replay is shown.", icon=":material/videocam_off:")
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


def _preview_is_simulated(kind: str) -> bool:
    shown = resources.feed(kind).preview().capture
    return shown is not None and shown.simulated


def _panel(one: RoundView, home: str, kind: str) -> None:
    """Draw what a walker needs: the button, where the next stop is, what waits."""

    @st.fragment(run_every=_PANEL_S)
    def _draw() -> None:
        _begin_place(one.key, home)
        shutter, waits, place = (st.container() for _ in range(3))
        with shutter:
            for press in _presses():
                _take(one, kind, press)
        with place:
            _place()
        with waits:
            _waits(one, home)

    _draw()


def _begin_place(opened: str, home: str) -> None:
    """Go on from the round's last stop, measured or not; later input is kept."""
    state = st.session_state
    begun = state.get("place_of") == home
    if begun and _read_typed():
        return
    waiting = [one.stop for one in resources.waiting().captures() if one.round_key == home]
    stops = resources.store().stops(home) if _is_round(home) else []
    pressing = [one.stop for one in resources.shutter().pressed(opened) if not one.kept.done()]
    taken: list[Stop | StopView] = [*stops, *waiting, *pressing]
    state["place_of"], state["place_sides"] = home, sides_of(stops)
    on = next_place(taken)
    # Somebody else who walks the same round may have been here meanwhile.
    passed = begun and unless_taken(here := _stop_of(state["place"]), taken) != here
    if not begun or (passed and on != state["place"]):
        _set_place(on)


def _is_round(key: str) -> bool:
    return any(one.key == key for one in resources.store().rounds())


def _set_place(place: NextPlace) -> None:
    # Fields of new names: those on the page keep what was typed, whatever their value is set to.
    st.session_state["place"] = st.session_state["place_as_set"] = place
    st.session_state["place_number"] = st.session_state.get("place_number", 0) + 1


def _stop_of(place: NextPlace) -> Stop:
    return Stop(place.row or None, place.side, place.position_m)


def _read_typed() -> bool:
    """Read what was typed since the fields were drawn; return whether anything was."""
    state, place = st.session_state, st.session_state["place"]

    def typed(name: str, known: Any) -> Any:
        found = state.get(f"{name}_{state['place_number']}")
        return known if found is None else found

    state["place"] = NextPlace(
        typed("row", place.row).strip(),
        typed("side", place.side),
        float(typed("position", place.position_m)),
        float(typed("step", place.step_m)),
        typed("way", "back" if place.back else "onward") == "back",
    )
    return bool(state["place"] != state["place_as_set"])


def _place() -> None:
    place, number = st.session_state["place"], st.session_state["place_number"]
    row, side = st.columns(2)
    row.text_input("Row", place.row, key=f"row_{number}")
    sides = list(dict.fromkeys([*st.session_state["place_sides"], place.side]))
    side.segmented_control(
        "Side",
        sides,
        default=place.side,
        format_func=str.capitalize,
        key=f"side_{number}",
        required=True,
    )
    position, step = st.columns(2)
    position.number_input(
        "Next stop at [m]", 0.0, None, place.position_m, 0.1, "%.2f", key=f"position_{number}"
    )
    step.number_input("Step [m]", 0.0, 5.0, place.step_m, 0.1, "%.2f", key=f"step_{number}")
    st.segmented_control(
        "Along the row",
        ["onward", "back"],
        default="back" if place.back else "onward",
        format_func={"onward": "Positions increase", "back": "Positions decrease"}.__getitem__,
        key=f"way_{number}",
        required=True,
        width="stretch",
    )


def _presses() -> list[Press]:
    """Draw the button; return its presses, those that were returned before among them."""
    waiting = len(resources.waiting().captures())
    words = f"{waiting} waiting to be measured" if waiting else "press as fast as you walk"
    data = {"label": "Capture", "words": words, "now_s": time.time(), "disabled": False}
    made = component("shutter")(key="take", data=data, on_presses_change=lambda: None)
    return [Press(str(one["number"]), float(one["at_s"])) for one in made.presses or ()]


def _take(one: RoundView, kind: str, press: Press) -> None:
    place = st.session_state["place"]
    burst, feed = resources.settings().burst, resources.feed(kind)
    if resources.shutter().press(feed, burst, one.key, _stop_of(place), press):
        _set_place(place.onward())


def _waits(one: RoundView, home: str) -> None:
    """Show the outcome of the presses, and redraw the page when a stop was measured."""
    pressed = resources.shutter().pressed(one.key)
    failed: dict[str, list[str]] = {}
    for taken in pressed[-_SHOWN_PRESSES:]:
        if taken.error:
            when = time.strftime("%H:%M:%S", time.localtime(taken.pressed_s))
            failed.setdefault(taken.error, []).append(when)
    for error, when_all in failed.items():
        presses = counted(len(when_all), "press gave", "presses gave")
        st.error(
            f"{presses} no stop ({', '.join(when_all)}): {plain(error)}", icon=":material/error:"
        )
    for taken in pressed[-3:][::-1]:
        if (moved := taken.moved) is not None:
            st.warning(
                f"Another stop is already at {taken.stop.position_m:.2f} m: this one was saved as "
                f"{plain(stop_name(moved))}. 'Correct' moves it.",
                icon=":material/wrong_location:",
            )
    waiting, measuring = resources.waiting(), resources.wake()
    left = waiting.captures()
    busy = sum(not taken.kept.done() for taken in pressed)
    if left or busy:
        is_measuring = measuring is not None and not measuring.finished
        last = f" Last kept: {plain(stop_name(left[-1].stop))}." if left else ""
        st.markdown(
            f":material/hourglass: **{len(left) + busy} waiting.** "
            f"{'Measuring' if is_measuring else 'Keeping'} …{last}"
        )
    if aside := waiting.set_aside():
        st.warning(
            f"{len(aside)} captures failed three times and were not measured; they are kept in "
            f"{plain(aside[0].folder.parent)}.",
            icon=":material/error:",
        )
    stops = len(resources.store().stops(home)) if _is_round(home) else 0
    if stops != st.session_state.setdefault("stops_shown", stops):
        st.session_state["stops_shown"] = stops
        st.rerun()


_EXPOSURES = {None: "Camera default", "automatic": "Automatic", "fixed": "Manual"}
_USUAL_US = 8000.0  # a bright house


def _camera() -> None:
    """Draw preset and exposure; the camera is opened again where they change."""
    with st.expander("Camera", icon=":material/photo_camera:"):
        now = resources.settings()
        preset = st.selectbox(
            "Depth preset",
            PRESETS,
            PRESETS.index(now.camera_preset),
            format_func=lambda name: name.replace("-", " ") or "camera default",
        )
        known = None if now.exposure_us is None else "fixed" if now.exposure_us else "automatic"
        chosen = st.selectbox(
            "Exposure of the colour camera",
            list(_EXPOSURES),
            list(_EXPOSURES).index(known),
            format_func=_EXPOSURES.__getitem__,
        )
        exposure_us = None if chosen is None else 0.0
        if chosen == "fixed":
            usual = now.exposure_us or _USUAL_US
            exposure_us = st.number_input("Microseconds", *EXPOSURE_US, usual, 500.0, "%.0f")
        resources.change_settings(camera_preset=preset, exposure_us=exposure_us)
        resources.camera().configure(resources.settings().camera)


def _how() -> None:
    with st.expander("How to measure", icon=":material/tune:"):
        now = resources.settings()
        resources.change_settings(
            burst=st.slider("Frames per capture", 1, 15, now.burst),
            confidence=st.slider(
                "Minimum confidence of a detection", 0.05, 0.95, now.confidence, 0.05
            ),
            input_sizes=tuple(
                st.multiselect(
                    "Network input size, pixels (long side)",
                    sorted({*_INPUT_SIZES_PX, *now.input_sizes}),
                    now.input_sizes,
                    placeholder="Default",
                    max_selections=2,
                    help="Larger sizes find smaller fruit but are slower. Two sizes are merged.",
                )
            ),
            selector=st.segmented_control(
                "Choice of method",
                list(Selector),
                format_func={Selector.BEST: "Best", Selector.PAPER: "As in the paper"}.__getitem__,
                default=now.selector,
                required=True,
            )
            or now.selector,
        )


def _preview(kind: str) -> None:
    live, absent = st.container(), st.container()
    seen = resources.feed(kind).preview()
    if seen.state == "absent":
        if kind == "camera" and not st.session_state.get("source_chosen"):
            st.session_state["no_camera"] = True
            st.rerun()
        with absent:
            _absent(kind, seen)
        return

    @st.fragment(run_every=0.5)
    def _live() -> None:
        opening, pictures = st.container(), st.container(key="live")
        preview = resources.feed(kind).preview()
        if preview.state == "absent":
            st.rerun()
        if preview.capture is None:
            opening.info("Opening …", icon=":material/hourglass:")
            return
        shown = preview.capture
        near = preview.quality.distance_m if preview.quality else None
        small = shown.depth_m[::2, ::2]  # it is only looked at
        depth, words = depth_picture(small)
        with pictures:
            color_at, depth_at = st.columns(2)
        with color_at:
            picture(
                f"preview_{kind}",
                {"live": as_data_url(shown.color, _PREVIEW_PX)},
                (shown.width, shown.height),
                bar=scale_bar(shown.intrinsics, near, resources.settings().units),
                title="Camera picture",
            )
        with depth_at:
            size = (small.shape[1], small.shape[0])
            title = "Camera depth"
            picture(f"depth_{kind}", {"depth": as_data_url(depth)}, size, title=title)
        st.caption(f"Depth: {words}.")
        _quality(preview)

    with live:
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
    states = {"replay": "Replay", "playing": "Recording"}
    state = states.get(preview.state, "Live")
    simulated = ", simulated" if preview.capture.simulated else ""
    advice.caption(f"{state}: {plain(preview.capture.name)}{simulated}")


def _last_stop(one: RoundView, home: str) -> None:
    """Draw the stop that was measured last, and its fruit."""
    stops = resources.store().stops(home) if _is_round(home) else []
    if not stops:
        st.caption("No stops yet. Each capture's result is shown here.")
        return
    last = stops[-1]
    says, change = st.columns([3, 1], vertical_alignment="center")
    says.markdown(f"**{plain(stop_name(last))}: saved**")
    with change.popover(
        "Correct",
        icon=":material/edit_location:",
        width="stretch",
        key=CORRECTING,
        on_change="rerun",
    ):
        change_stop(last, sides_of(stops))
    if last.failures:
        found = resources.store().stop(last.key).failures[0]
        st.warning(f"Saved, but not measured: {plain(found['message'])}", icon=":material/warning:")
    _picture(one, last)


def _picture(one: RoundView, last: StopView) -> None:
    store, units = resources.store(), resources.settings().units
    record = store.stop(last.key)
    views = store.detections(last.round_key, DetectionFilter(stop_key=last.key))
    profile = resources.profile_of(one)[1]
    for taken in record.captures:
        own = [view for view in views if view.capture == taken.name]
        grades = {view.key: grade_name(grade(view.record, profile)) for view in own}
        try:
            capture = stored_capture(store.images, taken, record)
        except CucumberVisionError as error:
            st.warning(plain(error), icon=":material/broken_image:")
            continue
        tapped = picture(
            f"result_{last.key}_{taken.name}",
            {"measured": as_data_url(capture.color)},
            (capture.width, capture.height),
            layers=stop_layers(taken, own, grades, units),
            tools=("point", "box"),
            title="The measured fruit. Tap or draw a box to add a missed one",
            zooms=True,
        )
        if tapped.point or tapped.box:
            add_fruit(record, capture, tapped.point, tapped.box)
        show_correction()
        lines = [
            {
                "Fruit": view.record.number,
                "Length": length_words(view.record, units),
                "Class": grades[view.key],
            }
            for view in own
        ]
        if lines:
            page_elements.table(lines)
        elif not last.failures:
            st.info("No fruit was found in this capture.", icon=":material/search_off:")
