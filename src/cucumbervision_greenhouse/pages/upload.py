"""Upload: captures from other devices into a round, checked before anything reads them."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.capture.readers import RECORDING_SUFFIXES
from cucumbervision.errors import NameRefusedError
from cucumbervision.names import LONGEST_NAME, checked_name
from cucumbervision_greenhouse import resources, tasks
from cucumbervision_greenhouse.language import counted, plain, sentence, words_of
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.page_elements import component
from cucumbervision_greenhouse.rounds.walking import NextPlace, next_place, sides_of
from cucumbervision_greenhouse.uploads import CAMERAS, MOST_FILES
from cucumbervision_greenhouse.words import round_day, side_words

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from cucumbervision_greenhouse.round_view import RoundView
    from cucumbervision_greenhouse.store.records import Round
    from cucumbervision_greenhouse.uploads import Upload

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
    """Draw where the first capture was taken, for files that do not say; it goes on from there.

    What was typed stays until it was sent, also in the address for a reload; another row goes on
    where its last stop is.
    """
    stops = resources.store().stops(round_summary.key)
    sides = sides_of(stops)
    keys = {name: f"up_{name}_{round_summary.key}" for name in ("row", "side", "at", "step", "way")}

    def suggest(place: NextPlace) -> None:
        side = place.side if place.side in sides else sides[0]
        per_metre = resources.settings().units.along[1]
        at, step = place.position_m * per_metre, place.step_m * per_metre
        values = place.row, side, at, step, "down" if place.back else "up"
        st.session_state.update(zip(keys.values(), values, strict=True))

    def change_row() -> None:
        row = st.session_state[keys["row"]].strip()
        side = st.session_state[keys["side"]]
        row_stops = [stop for stop in stops if (stop.row or "") == row]
        suggest(next_place(row_stops) if row_stops else NextPlace(row, side))
        keep()

    def keep() -> None:
        page_elements.name_in_address("row", st.session_state[keys["row"]].strip())

    sent = [upload.sending.key for upload in resources.uploads().all(round_summary.key)[:1]]
    basis = (tuple(sent), round_summary.stops)
    before = st.session_state.get(f"up_given_{round_summary.key}")
    is_typed = "row" in st.query_params
    if before is not None and before[0] != basis[0] and is_typed:
        page_elements.name_in_address("row", None)  # it was sent: on from there
        is_typed = False
    if keys["row"] not in st.session_state or (before != basis and not is_typed):
        suggest(next_place(stops))
        if is_typed:
            st.session_state[keys["row"]] = st.query_params["row"][:LONGEST_NAME]
            change_row()
    st.session_state[f"up_given_{round_summary.key}"] = basis
    return _draw_place(keys, sides, change_row, keep)


def _draw_place(
    keys: Mapping[str, str],
    sides: Sequence[str],
    change_row: Callable[[], None],
    keep: Callable[[], None],
) -> NextPlace:
    """Draw the fields of a place by the keys of their values, and return what they hold."""
    unit, per_metre = resources.settings().units.along
    # In two lines, so that no choice is cut off on a tablet.
    row, side = st.columns(2)
    position, step, way = st.columns([2, 2, 3])
    named = row.text_input(_("Row"), max_chars=LONGEST_NAME, key=keys["row"], on_change=change_row)
    try:
        named = checked_name(named, "row")
    except NameRefusedError as error:
        st.warning(sentence(error), icon=":material/error:")
        named = ""
    return NextPlace(
        row=named,
        side=side.segmented_control(
            _("Side"),
            sides,
            format_func=_side_words,
            required=True,
            key=keys["side"],
            on_change=keep,
        )
        or sides[0],
        position_m=position.number_input(
            _("First at [{unit}]").format(unit=unit),
            0.0,
            step=0.1,
            format="%.2f",
            key=keys["at"],
            on_change=keep,
        )
        / per_metre,
        step_m=step.number_input(
            _("Step [{unit}]").format(unit=unit),
            0.0,
            5.0 * per_metre,
            step=0.1,
            key=keys["step"],
            on_change=keep,
        )
        / per_metre,
        back=way.segmented_control(
            _("Walking"),
            ["up", "down"],
            format_func={"up": _("up the row"), "down": _("down the row")}.__getitem__,
            required=True,
            width="stretch",
            key=keys["way"],
            on_change=keep,
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
        received = sum(uploads.received(sending.key))
        st.info(
            _(
                "{names}: {received} of {all} MB are here. Choose the same files again to send the "
                "rest."
            ).format(
                names=names, received=f"{received / 1e6:.0f}", all=f"{sending.size / 1e6:.0f}"
            ),
            icon=":material/upload:",
        )
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
