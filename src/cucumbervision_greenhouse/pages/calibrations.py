"""Calibrations on the pages: made from own fruit or a printed grid, chosen, and put back."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from functools import partial
from pathlib import Path

import streamlit as st

from cucumbervision.accuracy.calibration_file import (
    Form,
    SiteCalibration,
    read_site_calibration,
    write_site_calibration,
)
from cucumbervision.accuracy.own_truth import Measured
from cucumbervision.accuracy.site_calibration import calibrate_camera, calibrate_lengths
from cucumbervision.accuracy.truth import Truth
from cucumbervision.capture.source import safe_name
from cucumbervision.errors import CalibrationError, CucumberVisionError, Message
from cucumbervision.methods.result import LengthDefinition, MethodName, calibration_key
from cucumbervision.names import checked_name
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.language import counted, decimal_words, number_words, plain, sentence
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.rounds.adding import stored_capture
from cucumbervision_greenhouse.settings import Units, truth_folder
from cucumbervision_greenhouse.store.repository import Store

_GRID_MM = 1.0, 200.0, 10.0  # between the lines: least, most, usual


def draw_own_fruit(measured: Measured, truth: Truth) -> None:
    """Draw the button that calibrates with lengths by hand."""
    name = st.text_input(_("Name of the calibration"), _("my house"))
    label = _("Calibrate with these lengths")
    _make(label, lambda: calibrate_lengths(measured, truth, name.strip()))


def draw_grid(round_key: str) -> None:
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
        return calibrate_by_grid(store, round_key, spacing_mm / 1000, name.strip())

    _make(_("Calibrate with the pictures of this round"), calibrate)


def _make(label: str, calibrate: Callable[[], SiteCalibration]) -> None:
    """Draw a button that makes a calibration and saves it; then what it does, and 'Use it now'."""
    if not st.button(label, icon=":material/target:", width="stretch"):
        return
    try:
        site = calibrate()
        path = save_calibration(truth_folder(resources.where()), site)
    except (CucumberVisionError, ValueError) as error:
        st.error(sentence(error), icon=":material/error:")
        return
    st.success(plain(f"{site.name}: {_effect(site)}"))
    use = partial(resources.change_settings, calibration=str(path))
    page_elements.button(st, _("Use it now"), "check", use)


def draw_choice() -> None:
    """Draw all calibrations with what each does, to choose from."""
    chosen = resources.settings().calibration
    saved = saved_calibrations(truth_folder(resources.where()), chosen)
    if not saved:
        st.caption(_("No calibration yet: lengths are as the camera gives them."))
        return
    titles, effects = {"": _("none")}, [_("Lengths are as the camera gives them.")]
    for path, site in saved.items():
        if isinstance(site, SiteCalibration):
            titles[path], words = f"{site.name}, {site.created[:10]}", plain(_effect(site))
        else:
            titles[path], words = Path(path).name, sentence(site)
        effects.append(words)
    titles = {path: plain(title) for path, title in titles.items()}
    radio = partial(page_elements.choose, st.radio, captions=effects)
    page_elements.setting("calibration", radio, _("Calibration in use"), titles)
    st.caption(
        _(
            "A calibration counts for what is measured from now on, captures that wait included; "
            "measured fruit stay as they are, and each says its own in its details."
        )
    )


def _effect(site: SiteCalibration) -> str:
    settings = resources.settings()
    return effect_words(site, settings.length, settings.units)


_SUFFIX = ".calibration.json"


def save_calibration(folder: Path, site: SiteCalibration) -> Path:
    """Write a calibration into the folder of a store, under its name and the time; return the file.

    Raises
    ------
    CalibrationError
        If the file cannot be written.
    NameRefusedError
        If its name cannot be read.
    """
    moment = f"{datetime.now():%Y-%m-%d-%H%M%S-%f}"  # two viewers may make one at once
    name = safe_name(checked_name(site.name, "calibration's name"))
    path = folder / f"{moment}-{name}{_SUFFIX}"
    write_site_calibration(path, site)
    return path


def saved_calibrations(
    folder: Path, chosen: str = ""
) -> dict[str, SiteCalibration | CucumberVisionError]:
    """Return the calibrations of a folder by path, newest first, and the chosen one; or errors."""
    saved: dict[str, SiteCalibration | CucumberVisionError] = {}
    for path in sorted({*map(str, folder.glob(f"*{_SUFFIX}")), *filter(None, [chosen])}):
        try:
            saved[path] = read_site_calibration(Path(path))
        except CucumberVisionError as error:
            saved[path] = error
    created = {path: getattr(site, "created", "") for path, site in saved.items()}
    return {path: saved[path] for path in sorted(saved, key=created.__getitem__, reverse=True)}


def effect_words(site: SiteCalibration, length: LengthDefinition, units: Units) -> str:
    """Return what a calibration does, for fruit with a fitted tube.

    Parameters
    ----------
    site : SiteCalibration
        The calibration.
    length : LengthDefinition
        Definition of the reported length.
    units : Units
        Unit of lengths.
    """
    words = []
    if site.depth_scale is not None:
        percent = 100 * (site.depth_scale.value - 1)
        over, below = _("{percent} % too long"), _("{percent} % too short")
        error = (over if percent > 0 else below).format(percent=number_words(abs(percent), 1))
        words.append(
            counted(
                site.depth_scale.captures,
                "The camera reads {error}; that is taken out ({n} picture of a printed grid).",
                "The camera reads {error}; that is taken out ({n} pictures of a printed grid).",
                error=error,
            )
        )
    entry = site.entry(calibration_key(MethodName.M6, length), length)
    if site.is_of_other_version:
        words.append(_("Made with another version of this program: lengths stay as they are."))
    elif entry is not None:
        share = decimal_words(f"{100 * (entry.scale - 1):+.1f} %")
        offset = f"{'+' if entry.offset_m >= 0 else '−'} {units.text(abs(entry.offset_m))}"
        change = {
            Form.NONE: _("Lengths stay as they are"),
            Form.SCALE: _("Lengths change by {change}").format(change=share),
            Form.SCALE_OFFSET: _("Lengths change by {change}").format(change=f"{share} {offset}"),
        }[entry.form]
        words.append(
            counted(
                entry.fruit,
                "{change}: error {before} % before and {after} % after ({n} fruit measured by "
                "hand).",
                "{change}: error {before} % before and {after} % after ({n} fruit measured by "
                "hand, each left out in turn).",
                change=change,
                before=number_words(entry.error_before_percent, 1),
                after=number_words(entry.error_after_percent, 1),
            )
        )
    kind = {"centreline": _("centreline"), "thread": _("thread"), "chord": _("chord")}[length]
    return " ".join(words) or _("Corrects other lengths than the {kind}.").format(kind=kind)


def calibrate_by_grid(store: Store, round_key: str, spacing_m: float, name: str) -> SiteCalibration:
    """Calibrate a camera from a round's pictures of a printed grid.

    Raises
    ------
    CalibrationError
        If the round was measured with a calibration, shows no grid, or has several cameras.
    """
    stops = [store.stop(stop.key) for stop in store.stops(round_key)]
    if any(artifact.kind == "calibration" for stop in stops for artifact in stop.artifacts):
        raise CalibrationError(
            "these pictures were measured with a calibration, which changed their depth",
            source=Message("this round"),
            remedy="choose no calibration, begin a round and take pictures of the grid again",
        )
    captures = (
        stored_capture(store.images, record, stop) for stop in stops for record in stop.captures
    )
    return calibrate_camera(captures, spacing_m, name)
