"""Settings: crop, units, models, calibration."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import streamlit as st

from cucumbervision.accuracy.calibration_file import read_site_calibration
from cucumbervision.methods.result import Selector
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.camera import cameras
from cucumbervision_greenhouse.language import LANGUAGES, marked, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import calibrations, crop, page_elements
from cucumbervision_greenhouse.settings import EXPOSURE_US, PRESETS
from cucumbervision_greenhouse.words import LENGTH_NAMES

_FINDERS = {
    "auto": marked("A capture's own masks, else networks"),
    "models": marked("Networks"),
    "dataset": marked("A capture's own masks"),
}


_SELECT = partial(page_elements.choose, st.selectbox)
_SEGMENTS = partial(page_elements.choose, st.segmented_control, required=True)

_INPUT_SIZES_PX = (320, 448, 640, 960, 1280)  # that are offered; a file may name others


def page() -> None:
    """Draw the page."""
    crop, measuring = st.columns(2, gap="large")
    with crop:
        _crop()
        _camera()
    with measuring:
        _measuring()
        st.header(_("Calibration"))
        calibrations.draw_choice()
        page_elements.link("accuracy", _("Calibrate on 'Accuracy'"))
    with st.expander(_("Details: networks and method"), icon=":material/list:"):
        page_elements.setting(
            "calibration",
            st.text_input,
            _("Calibration file"),
            field="_file",
            meant=_readable,
            placeholder=_("none"),
            help=_("As `cucumbervision calibrate` writes it."),
        )
        _how()
        _models()
    st.caption(_("Store: {name}").format(name=plain(resources.store().name)))


def _crop() -> None:
    st.header(_("Crop and units"))
    names = {"": _("As the browser")} | LANGUAGES
    page_elements.setting("language", _SELECT, _("Language"), names)
    units = {"cm": _("Centimetres"), "in": _("Inches")}
    page_elements.setting("unit", _SEGMENTS, _("Lengths in"), units)
    crop.draw()


def _measuring() -> None:
    st.header(_("Measuring"))
    lengths = {kind: _(words) for kind, words in LENGTH_NAMES.items()}
    help_ = _(
        "Thread: over the outer side, as people measure by hand. Centreline: along the middle. "
        "Chord: straight from end to end."
    )
    page_elements.setting("length", _SEGMENTS, _("Length definition"), lengths, help=help_)
    finders = {name: _(words) for name, words in _FINDERS.items()}
    page_elements.setting("fruit_from", _SELECT, _("Find fruit by"), finders)
    exact = _("Same lengths on every computer (slower)")
    page_elements.setting("full_precision", st.toggle, exact)
    page_elements.setting("burst", st.number_input, _("Frames per photo"), 1, 15)
    limit_mb = _("Upload at most [MB]")
    page_elements.setting("upload_limit_mb", st.number_input, limit_mb, 1, 1_000_000, step=100)


def _readable(path: str) -> str:
    """Return the path of a calibration file, or nothing; raise the error of one that is none."""
    if path := path.strip():
        read_site_calibration(Path(path))
    return path


_EXPOSURES = {
    None: marked("Camera default"),
    "automatic": marked("Automatic"),
    "fixed": marked("Manual"),
}
_USUAL_US = 8000.0  # a bright house


def _camera() -> None:
    """Draw preset and exposure; the camera is opened again where they change."""
    st.header(_("Camera"))
    presets = {name: name.replace("-", " ") or _("Camera default") for name in PRESETS}
    page_elements.setting("camera_preset", _SELECT, _("Depth preset"), presets)
    exposures = {name: _(words) for name, words in _EXPOSURES.items()}
    page_elements.setting(
        "exposure_us",
        _SELECT,
        _("Exposure of the colour camera"),
        exposures,
        field="_by",
        shown=lambda us: None if us is None else "fixed" if us else "automatic",
        meant={None: None, "automatic": 0.0, "fixed": _USUAL_US}.__getitem__,
        placeholder=exposures[None],  # a choice of None counts as no choice
    )
    if resources.settings().exposure_us:
        how: dict[str, Any] = {"step": 500.0, "format": "%.0f"}
        microseconds = _("Microseconds")
        page_elements.setting("exposure_us", st.number_input, microseconds, *EXPOSURE_US, **how)
    cameras.camera().configure(resources.settings().camera)


def _how() -> None:
    confidence = _("Minimum confidence of a detection")
    page_elements.setting("confidence", st.number_input, confidence, 0.05, 0.95, step=0.05)
    page_elements.setting(
        "input_sizes",
        st.pills,
        _("Network input size, pixels (long side); none: its own, two: both are merged"),
        sorted({*_INPUT_SIZES_PX, *resources.settings().input_sizes}),
        shown=list,
        meant=lambda sizes_px: tuple(sizes_px[-2:]),
        selection_mode="multi",
    )
    selectors = {Selector.BEST: _("Best"), Selector.PAPER: _("As in the paper")}
    page_elements.setting("selector", _SEGMENTS, _("Choice of method"), selectors)


def _models() -> None:
    registry = resources.registry()
    tasks = {
        "segment": _("finds fruit"),
        "pose": _("finds end points"),
        "prompted-mask": _("outlines fruit"),
        "fruit": _("looks at each fruit"),
        "look": _("looks at each end"),
    }
    lines = [
        {
            _("Network"): model.name,
            _("Does"): tasks.get(model.task, model.task),
            _("Here"): _("built in") if model.embedded else _("fetched"),
            _("Size"): f"{model.size_bytes / 1e6:.0f} MB",
            _("Licence"): model.licence,
        }
        for model in registry.models
    ]
    page_elements.table(lines)
    if registry.default("segment") is None:
        st.info(
            _(
                "This version comes without a detector of its own: fruit are found only in "
                "captures that bring masks, as the bundled ones do."
            ),
            icon=":material/info:",
        )
