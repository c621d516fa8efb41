"""Calibrations on the pages: made from own fruit or a printed grid, chosen, and put back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.accuracy.site_calibration import calibrate_lengths
from cucumbervision.errors import CucumberVisionError
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.core_words import words_of
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.language import plain, sentence
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.hand_lengths import truth_folder
from cucumbervision_greenhouse.pages.site_calibrations import (
    SavedCalibration,
    calibrate_by_grid,
    effect_words,
    save_calibration,
    saved_calibrations,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from cucumbervision.accuracy.calibration_file import SiteCalibration
    from cucumbervision.accuracy.own_truth import Measured
    from cucumbervision.accuracy.truth import Truth
    from cucumbervision_greenhouse.store.records import Round

_GRID_MM = 1.0, 200.0, 10.0  # between the lines: least, most, usual


def draw_own_fruit(measured: Measured, truth: Truth) -> None:
    """Draw the button that calibrates with lengths by hand."""
    name = st.text_input(_("Name of the calibration"), _("my house"))
    label = _("Calibrate with these lengths")
    _make(label, lambda: calibrate_lengths(measured, truth, name.strip()))


def draw_grid(round_summary: Round) -> None:
    """Draw the form that calibrates a camera with a round's pictures of a printed grid."""
    st.write(
        _(
            "Lay a flat printed grid of squares, such as a cutting mat, where the fruit will be, "
            "and take a few pictures of it from several sides in a round of their own."
        )
    )
    spacing_mm = st.number_input(_("Millimetres between the lines"), *_GRID_MM, 1.0)
    name = st.text_input(_("Name of the calibration"), _("my camera"), key="grid_name")

    def calibrate() -> SiteCalibration:
        store = resources.store()
        return calibrate_by_grid(store, round_summary.key, spacing_mm / 1000, name.strip())

    _make(_("Calibrate with the pictures of this round"), calibrate)


def _make(label: str, calibrate: Callable[[], SiteCalibration]) -> None:
    """Draw a button that makes a calibration and saves it; then what it does, and 'Use it now'."""
    made = f"made: {label}"
    if st.button(label, icon=":material/target:", width="stretch"):
        st.session_state.pop(made, None)
        try:
            st.session_state[made] = str(
                save_calibration(truth_folder(resources.where()), calibrate())
            )
        except (CucumberVisionError, ValueError) as error:
            st.error(sentence(words_of(error)), icon=":material/error:")
    path = st.session_state.get(made)
    for calibration in saved_calibrations(truth_folder(resources.where())):
        if str(calibration.path) == path:
            _draw(calibration, key=made)


def draw_choice() -> None:
    """Draw all calibrations with what each does; one tap uses one, one more goes back."""
    settings = resources.settings()
    saved = saved_calibrations(truth_folder(resources.where()), settings.calibration)
    in_use = next((x for x in saved if _is_used(x)), None)
    if not saved:
        st.caption(_("No calibration yet: lengths are as the camera gives them."))
        return
    before = st.session_state.get("calibration_before")
    if in_use is not None or before is not None:
        title = _("none") if in_use is None else in_use.title
        says, undo = st.columns([3, 2], vertical_alignment="center")
        says.markdown(_("**In use: {name}**").format(name=plain(title)))
        label = _("Use none") if before is None else _("Back to the one before")
        page_elements.button(undo, label, "undo", _use, before or "")
    for calibration in saved:
        _draw(calibration, key=str(calibration.path))
    st.caption(
        _(
            "A calibration counts for what is measured from now on, captures that wait included; "
            "measured fruit stay as they are, and each says its own in its details."
        )
    )


def _draw(calibration: SavedCalibration, key: str) -> None:
    """Draw a calibration: its name and day, what it does, and the button that uses it."""
    settings = resources.settings()
    with st.container(border=True):
        says, use = st.columns([3, 1], vertical_alignment="center")
        says.markdown(f"**{plain(calibration.title)}**")
        if calibration.site is None:
            says.warning(sentence(words_of(calibration.fault)), icon=":material/error:")
            return
        says.caption(plain(effect_words(calibration.site, settings.length, settings.units)))
        path = str(calibration.path)
        is_used = _is_used(calibration)
        label = _("In use") if is_used else _("Use it now")
        page_elements.button(use, label, "check", _use, path, disabled=is_used, key=f"use {key}")


def _is_used(calibration: SavedCalibration) -> bool:
    chosen = resources.settings().calibration
    return bool(chosen) and calibration.path == Path(chosen)


def _use(path: str) -> None:
    """Use a calibration, or none, and remember the one that it replaces."""
    st.session_state["calibration_before"] = resources.settings().calibration
    resources.change_settings(calibration=path)
