"""Upload: captures from other devices into a round, checked before anything reads them."""

from __future__ import annotations

from dataclasses import asdict
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
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds.walking import NextPlace, next_place, sides_of
from cucumbervision_greenhouse.store.records import Round
from cucumbervision_greenhouse.uploads import CAMERAS, MOST_FILES, Upload
from cucumbervision_greenhouse.words import round_day, side_words

_SHOWN = 5  # uploads whose outcomes are shown

_ENDINGS = [*("zip", "json", "csv", "raw"), *("png", "jpg", "jpeg", "tif", "tiff", "npy")]


@page_elements.of_round
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
    camera = st.selectbox(
        _("Camera of pictures without a camera file"),
        ["", *CAMERAS],
        format_func=lambda name: name or _("unknown: do not measure them"),
        help=_(
            "Typical figures differ from those of your camera by 1 to 2 %, and so do the lengths. "
            "Upload your camera's own file if you have one."
        ),
    )
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
        return {"key": f"{fields}_{name}", "on_change": keep}

    # In two lines, so that no choice is cut off on a tablet.
    row, side = st.columns(2)
    position, step, way = st.columns([2, 2, 3])
    typed = st.query_params.get("row", next_place(stops).row)[:LONGEST_NAME]
    named = row.text_input(_("Row"), max_chars=LONGEST_NAME, **field("row", typed)).strip()
    of_row = [stop for stop in stops if (stop.row or "") == named]
    usual = next_place(of_row) if of_row else NextPlace(named)
    try:
        named = checked_name(named, "row")
    except NameRefusedError as error:
        st.warning(sentence(error), icon=":material/error:")
        named = ""
    at_words, step_words = _("First at [{unit}]"), _("Step [{unit}]")
    side_of = field(f"side{named}", usual.side if usual.side in sides else sides[0])
    first = field(f"at{named}", usual.position_m * per_metre)
    stride = field(f"step{named}", usual.step_m * per_metre)
    walking = field(f"way{named}", "down" if usual.back else "up")
    how: dict[str, Any] = {"required": True, "width": "stretch"}
    return NextPlace(
        named,
        side.segmented_control(_("Side"), sides, format_func=_side_words, **how, **side_of)
        or sides[0],
        position.number_input(at_words.format(unit=unit), 0.0, step=0.1, format="%.2f", **first)
        / per_metre,
        step.number_input(step_words.format(unit=unit), 0.0, 5.0 * per_metre, step=0.1, **stride)
        / per_metre,
        way.segmented_control(
            _("Walking"),
            ["up", "down"],
            format_func={"up": _("up the row"), "down": _("down the row")}.__getitem__,
            **how,
            **walking,
        )
        == "down",
    )


def _side_words(side: str) -> str:
    words = side_words(side)
    return plain(words[:1].upper() + words[1:])


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
