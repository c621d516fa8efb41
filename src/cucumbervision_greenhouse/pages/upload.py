"""Upload: captures from other devices into a round, checked before anything reads them."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from typing import Any

import streamlit as st

from cucumbervision.capture.readers import RECORDING_SUFFIXES
from cucumbervision.errors import NameRefusedError
from cucumbervision.names import LONGEST_NAME, checked_name
from cucumbervision_greenhouse import resources, tasks
from cucumbervision_greenhouse.language import counted, plain, sentence, words_of
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.page_elements import component
from cucumbervision_greenhouse.pages.round_choice import of_round
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds.walking import NextPlace, next_place, sides_of
from cucumbervision_greenhouse.store.records import Round
from cucumbervision_greenhouse.uploads import CAMERAS, MOST_FILES, Upload
from cucumbervision_greenhouse.words import round_day, side_words

_SHOWN = 5  # uploads whose outcomes are shown

_ENDINGS = [*("zip", "json", "csv", "raw"), *("png", "jpg", "jpeg", "tif", "tiff", "npy")]


@partial(of_round, needs_stops=False)
def page(walk: RoundView) -> None:
    """Draw the page."""
    round_summary = walk.round
    st.write(
        _(
            "Zips of captures, or colour and depth pictures with matching names. Many at once, or "
            "a whole folder."
        )
    )
    place = _place(round_summary)
    cameras = {"": _("unknown: do not measure them")} | {name: name for name in CAMERAS}
    label = _("Camera of pictures without a camera file")
    help_ = _(
        "Typical figures differ from those of your camera by 1 to 2 %, and so do the lengths. "
        "Upload your camera's own file if you have one."
    )
    camera = page_elements.choose(st.selectbox, label, cameras, help=help_)
    component("upload")(
        key=f"upload_{round_summary.key}",
        data={
            "round": round_summary.key,
            "place": asdict(place),
            "camera": camera,
            "limit_mb": resources.settings().upload_limit_mb,
            "limit_files": MOST_FILES,
            "recordings": sorted(RECORDING_SUFFIXES),
            "accept": ",".join(f".{ending}" for ending in _ENDINGS),
        },
    )
    if walk.doubts:
        words = f"{_('Check the data of this round.')} {'. '.join(map(words_of, walk.doubts))}."
        st.warning(plain(words), icon=":material/error:")
    for upload in resources.uploads().all(round_summary.key)[:_SHOWN]:
        _show(upload)


def _place(round_summary: Round) -> NextPlace:
    """Draw where the first capture was taken, for files that do not say.

    The place after the last stop of the row is suggested. What was typed stays until it is sent,
    the row also in the address, for a reload.
    """
    key, units = round_summary.key, resources.settings().units
    stops, (unit, per_metre) = resources.store().stops(key), units.along
    sides = sides_of(stops)
    sent = [upload.sending.key for upload in resources.uploads().all(key)[:1]]
    basis = st.session_state.get(f"up_basis_{key}")
    if basis and basis[0] != sent:  # it was sent: on from there
        page_elements.name_in_address("row", None)
    if basis is None or "row" not in st.query_params:
        basis = st.session_state[f"up_basis_{key}"] = sent, len(stops)
    fields = f"up_{key}_{basis}"

    def keep() -> None:
        page_elements.name_in_address("row", st.session_state[f"{fields}_row"].strip())

    def field(name: str, value: object) -> dict[str, Any]:
        st.session_state.setdefault(f"{fields}_{name}", value)
        return {"key": f"{fields}_{name}", "on_change": keep, "persist_state": "session"}

    # In two lines, so that no choice is cut off on a tablet.
    row_column, side_column = st.columns(2)
    position, step, way = st.columns([2, 2, 3])
    typed = st.query_params.get("row", next_place(stops).row)[:LONGEST_NAME]
    row = row_column.text_input(_("Row"), max_chars=LONGEST_NAME, **field("row", typed)).strip()
    of_row = [stop for stop in stops if (stop.row or "") == row]
    usual = next_place(of_row) if of_row else NextPlace(row)
    try:
        name = checked_name(row, "row")
    except NameRefusedError as error:
        st.warning(sentence(error), icon=":material/error:")
        name = ""
    segments = partial(page_elements.choose, required=True, width="stretch")
    side_of = field(f"side{row}", usual.side if usual.side in sides else sides[0])
    names = {side: plain((x := side_words(side))[:1].upper() + x[1:]) for side in sides}
    side = segments(side_column.segmented_control, _("Side"), names, **side_of)
    words = _("First at [{unit}]").format(unit=unit)
    place = field(f"at{row}", usual.position_m * per_metre)
    first = position.number_input(words, 0.0, step=0.1, format="%.2f", **place)
    words, apart = _("Step [{unit}]").format(unit=unit), usual.step_m * per_metre
    stride = step.number_input(words, 0.0, 5.0 * per_metre, step=0.1, **field(f"step{row}", apart))
    ways = {False: _("up the row"), True: _("down the row")}
    is_back = segments(way.segmented_control, _("Walking"), ways, **field(f"way{row}", usual.back))
    return NextPlace(name, side or sides[0], first / per_metre, stride / per_metre, bool(is_back))


def _show(upload: Upload) -> None:
    """Draw an upload: what is there of it, or the outcome of each of its files."""
    sending, uploads = upload.sending, resources.uploads()
    names = ", ".join(plain(file.name) for file in sending.files[:3])
    if len(sending.files) > 3:
        names = _("{names} and {n} more").format(names=names, n=len(sending.files) - 3)
    if not upload.done and not uploads.is_whole(sending.key):
        words = _(
            "{names}: {received} of {all} MB are here. Choose the same files again to send the "
            "rest."
        )
        received_mb, all_mb = sum(uploads.received(sending.key)) / 1e6, sending.size / 1e6
        words = words.format(names=names, received=f"{received_mb:.0f}", all=f"{all_mb:.0f}")
        st.info(words, icon=":material/upload:")
        return
    saved = sum(outcome.saved for outcome in upload.outcomes)
    not_saved = len(upload.outcomes) - saved
    words = counted(saved, "{n} capture saved", "{n} captures saved")
    if not_saved:
        words = _("{saved}, {n} not").format(saved=words, n=not_saved)
    when = round_day(upload.begun_s)
    if not upload.done:
        st.info(f"{names}, {when}: {plain(tasks.upload_fault()) or _('waiting')}.")
        return
    (st.success if saved else st.warning)(f"{names}, {when}: {words}.")
    if saved:
        page_elements.link("results", _("Results"))
    lines = [
        {
            _("File"): outcome.name,
            "": _("saved") if outcome.saved else _("not saved"),
            _("Result"): words_of(outcome.words),
        }
        for outcome in sorted(upload.outcomes, key=lambda outcome: outcome.saved)
    ]
    if lines:
        page_elements.table(lines)
