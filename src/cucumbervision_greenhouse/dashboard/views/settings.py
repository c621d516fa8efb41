"""Settings: crop, units, models, calibration."""

from __future__ import annotations

from pathlib import Path

import streamlit as st

from cucumbervision.calibration.calibration_file import read_site_calibration
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import LengthDefinition, Selector
from cucumbervision_greenhouse.backend import cameras, resources
from cucumbervision_greenhouse.backend.settings import EXPOSURE_US, PRESETS
from cucumbervision_greenhouse.backend.words import plain
from cucumbervision_greenhouse.dashboard import page_elements
from cucumbervision_greenhouse.dashboard.views import calibrations, crop_form

_FINDERS = {
    "auto": "A capture's own masks, else networks",
    "models": "Networks",
    "dataset": "A capture's own masks",
}


_INPUT_SIZES_PX = (320, 448, 640, 960, 1280)  # that are offered; a file may name others


def page() -> None:
    """Draw the page."""
    crop, measuring = st.columns(2, gap="large")
    with crop:
        _crop()
        _camera()
    with measuring:
        _measuring()
        _calibration()
    with st.expander("Details: networks and method", icon=":material/list:"):
        _other_calibration()
        _how()
        _models()
    st.caption(f"Store: {plain(resources.store().name)}")


def _crop() -> None:
    st.subheader("Crop and units")
    saved = resources.settings()
    unit = st.segmented_control(
        "Lengths in",
        ["cm", "in"],
        format_func={"cm": "Centimetres", "in": "Inches"}.__getitem__,
        default=saved.unit,
        required=True,
    )
    resources.change_settings(unit=unit)
    crop_form.draw()


def _measuring() -> None:
    st.subheader("Measuring")
    saved = resources.settings()
    lengths = list(LengthDefinition)
    length = st.segmented_control(
        "Length definition",
        lengths,
        format_func=lambda x: str(x).capitalize(),
        default=saved.length,
        required=True,
        help="Thread: over the outer side, as people measure by hand. Centreline: along the "
        "middle. Chord: straight from end to end.",
    )
    finder = st.selectbox(
        "Find fruit by",
        list(_FINDERS),
        index=list(_FINDERS).index(saved.fruit_from),
        format_func=_FINDERS.__getitem__,
    )
    exact = st.toggle("Same lengths on every computer (slower)", saved.full_precision)
    burst = st.number_input("Frames per photo", 1, 15, saved.burst)
    limit_mb = st.number_input("Upload at most [MB]", 1, 1_000_000, saved.upload_limit_mb, 100)
    resources.change_settings(
        length=length,
        fruit_from=finder,
        full_precision=exact,
        upload_limit_mb=limit_mb,
        burst=burst,
    )


def _calibration() -> None:
    st.subheader("Calibration")
    calibrations.draw_choice()
    page_elements.link("accuracy", "Calibrate on 'Accuracy'")


def _other_calibration() -> None:
    """Draw a field for a calibration file from elsewhere."""
    saved = resources.settings().calibration
    calibration = st.text_input(
        "Calibration file",
        saved,
        placeholder="none",
        help="As `cucumbervision calibrate` writes it.",
    ).strip()
    if calibration == saved:
        return
    try:
        if calibration:
            read_site_calibration(Path(calibration))
    except CucumberVisionError as error:
        st.error(plain(error), icon=":material/error:")
    else:
        resources.change_settings(calibration=calibration)
        st.rerun()


_EXPOSURES = {None: "Camera default", "automatic": "Automatic", "fixed": "Manual"}
_USUAL_US = 8000.0  # a bright house


def _camera() -> None:
    """Draw preset and exposure; the camera is opened again where they change."""
    st.subheader("Camera")
    saved = resources.settings()
    preset = st.selectbox(
        "Depth preset",
        PRESETS,
        PRESETS.index(saved.camera_preset),
        format_func=lambda name: name.replace("-", " ") or "camera default",
    )
    exposure = None if saved.exposure_us is None else "fixed" if saved.exposure_us else "automatic"
    chosen = st.selectbox(
        "Exposure of the colour camera",
        list(_EXPOSURES),
        list(_EXPOSURES).index(exposure),
        format_func=_EXPOSURES.__getitem__,
    )
    exposure_us = None if chosen is None else 0.0
    if chosen == "fixed":
        usual = saved.exposure_us or _USUAL_US
        exposure_us = st.number_input("Microseconds", *EXPOSURE_US, usual, 500.0, "%.0f")
    resources.change_settings(camera_preset=preset, exposure_us=exposure_us)
    cameras.camera().configure(resources.settings().camera)


def _how() -> None:
    saved = resources.settings()
    resources.change_settings(
        confidence=st.number_input(
            "Minimum confidence of a detection", 0.05, 0.95, saved.confidence, 0.05
        ),
        input_sizes=tuple(
            st.pills(
                "Network input size, pixels (long side); none: its own, two: both are merged",
                sorted({*_INPUT_SIZES_PX, *saved.input_sizes}),
                selection_mode="multi",
                default=saved.input_sizes,
            )[-2:]
        ),
        selector=st.segmented_control(
            "Choice of method",
            list(Selector),
            format_func={Selector.BEST: "Best", Selector.PAPER: "As in the paper"}.__getitem__,
            default=saved.selector,
            required=True,
        )
        or saved.selector,
    )


def _models() -> None:
    registry = resources.registry()
    tasks = {
        "segment": "finds fruit",
        "pose": "finds end points",
        "prompted-mask": "outlines fruit",
        "ends": "finds the stem end",
        "crops": "looks at each detection",
        "look": "looks at each end",
    }
    lines = [
        {
            "Network": model.name,
            "Does": tasks.get(model.task, model.task),
            "Here": registry.state(model.name),
            "Size": f"{registry.size_bytes(model.name) / 1e6:.0f} MB",
            "Licence": model.licence,
        }
        for model in registry.models
    ]
    page_elements.table(lines)
    if registry.default("segment") is None:
        st.info(
            "This version comes without a detector of its own: fruit are found only in captures "
            "that bring masks, as the bundled ones do.",
            icon=":material/info:",
        )
