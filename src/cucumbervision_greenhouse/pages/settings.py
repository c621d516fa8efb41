"""Settings: crop, units, models, calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import streamlit as st

from cucumbervision.accuracy.calibration_file import read_site_calibration
from cucumbervision.errors import CucumberVisionError
from cucumbervision.methods.result import LengthDefinition, Selector
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.camera import cameras
from cucumbervision_greenhouse.language import DRAFTS, LANGUAGES, marked, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import calibrations, crop, page_elements
from cucumbervision_greenhouse.settings import EXPOSURE_US, PRESETS
from cucumbervision_greenhouse.words import LENGTH_NAMES

_FINDERS = {
    "auto": marked("A capture's own masks, else networks"),
    "models": marked("Networks"),
    "dataset": marked("A capture's own masks"),
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
        st.header(_("Calibration"))
        calibrations.draw_choice()
        page_elements.link("accuracy", _("Calibrate on 'Accuracy'"))
    with st.expander(_("Details: networks and method"), icon=":material/list:"):
        _other_calibration()
        _how()
        _models()
    st.caption(_("Store: {name}").format(name=plain(resources.store().name)))


def _crop() -> None:
    st.header(_("Crop and units"))
    _language()
    page_elements.setting(
        "unit",
        st.segmented_control,
        _("Lengths in"),
        ["cm", "in"],
        format_func={"cm": _("Centimetres"), "in": _("Inches")}.__getitem__,
        required=True,
    )
    crop.draw()


def _language() -> None:
    """Draw the choice of the language, which all pages show at once."""
    # A reader of that language sees in it that its texts are a draft.
    draft = {"nl": " (concept)", "es": " (borrador)"}
    names = {"": _("As the browser")}
    names |= {x: name + draft.get(x, "") * (x in DRAFTS) for x, name in LANGUAGES.items()}
    choose: dict[str, Any] = {"format_func": names.__getitem__}
    page_elements.setting("language", st.selectbox, _("Language"), list(names), **choose)


def _measuring() -> None:
    st.header(_("Measuring"))
    page_elements.setting(
        "length",
        st.segmented_control,
        _("Length definition"),
        list(LengthDefinition),
        format_func=lambda x: _(LENGTH_NAMES[x]),
        required=True,
        help=_(
            "Thread: over the outer side, as people measure by hand. Centreline: along the "
            "middle. Chord: straight from end to end."
        ),
    )
    page_elements.setting(
        "fruit_from",
        st.selectbox,
        _("Find fruit by"),
        list(_FINDERS),
        format_func=lambda name: _(_FINDERS[name]),
    )
    exact = _("Same lengths on every computer (slower)")
    page_elements.setting("full_precision", st.toggle, exact)
    page_elements.setting("burst", st.number_input, _("Frames per photo"), 1, 15)
    limit_mb = _("Upload at most [MB]")
    page_elements.setting("upload_limit_mb", st.number_input, limit_mb, 1, 1_000_000, step=100)


def _other_calibration() -> None:
    """Draw a field for a calibration file from elsewhere."""
    saved = resources.settings().calibration
    calibration = st.text_input(
        _("Calibration file"),
        saved,
        placeholder=_("none"),
        help=_("As `cucumbervision calibrate` writes it."),
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


_EXPOSURES = {
    None: marked("Camera default"),
    "automatic": marked("Automatic"),
    "fixed": marked("Manual"),
}
_USUAL_US = 8000.0  # a bright house


def _camera() -> None:
    """Draw preset and exposure; the camera is opened again where they change."""
    st.header(_("Camera"))
    page_elements.setting(
        "camera_preset",
        st.selectbox,
        _("Depth preset"),
        PRESETS,
        format_func=lambda name: name.replace("-", " ") or _("Camera default"),
    )
    page_elements.setting(
        "exposure_us",
        st.selectbox,
        _("Exposure of the colour camera"),
        list(_EXPOSURES),
        field="_by",
        shown=lambda us: None if us is None else "fixed" if us else "automatic",
        meant={None: None, "automatic": 0.0, "fixed": _USUAL_US}.__getitem__,
        format_func=lambda name: _(_EXPOSURES[name]),
        placeholder=_(_EXPOSURES[None]),  # a choice of None counts as no choice
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
    page_elements.setting(
        "selector",
        st.segmented_control,
        _("Choice of method"),
        list(Selector),
        format_func={Selector.BEST: _("Best"), Selector.PAPER: _("As in the paper")}.__getitem__,
        required=True,
    )


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
