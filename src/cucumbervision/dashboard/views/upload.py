"""Upload: captures from other devices into a round, checked before anything reads them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.fruit_view import component
from cucumbervision.dashboard.uploading import CAMERAS
from cucumbervision.dashboard.uploads import SentPlace
from cucumbervision.dashboard.words import counted, plain, round_day, sentence
from cucumbervision.errors import NameRefusedError
from cucumbervision.names import checked_name
from cucumbervision.rounds.walking import next_place, sides_of

if TYPE_CHECKING:
    from cucumbervision.dashboard.uploads import Upload
    from cucumbervision.store.views import RoundView

_SHOWN = 5  # uploads whose outcomes are shown

_ENDINGS = [
    *("zip", "bag", "db3", "json", "csv", "raw"),
    *("png", "jpg", "jpeg", "tif", "tiff", "npy", "npz"),
]


@page_elements.of_round
def page(one: RoundView) -> None:
    """Draw the page."""
    st.write(
        "Zips of captures, RealSense recordings (.bag, .db3), or colour and depth pictures with "
        "matching names. Many at once."
    )
    sender = st.container()
    place = _place(one)
    camera = st.selectbox(
        "Camera of pictures without intrinsics",
        ["", *CAMERAS],
        format_func=lambda name: name or "unknown: do not measure them",
        help="Typical figures differ from those of your camera by 1 to 2 %, and so do the lengths. "
        "Upload an intrinsics file if you have one.",
    )
    with sender:
        component("upload")(
            key=f"upload_{one.key}",
            data={
                "round": one.key,
                "place": place.model_dump(),
                "camera": camera,
                "limit_mb": resources.settings().upload_limit_mb,
                "accept": ",".join(f".{ending}" for ending in _ENDINGS),
            },
        )
    for upload in resources.uploads().all(one.key)[:_SHOWN]:
        _show(upload)


def _place(one: RoundView) -> SentPlace:
    """Draw where the first capture was taken, for files that do not say; it goes on from there."""
    stops = resources.store().stops(one.key)
    begun, sides = next_place(stops), sides_of(stops)
    # In two lines, so that no choice is cut off on a tablet.
    row, side = st.columns(2)
    position, step, way = st.columns([2, 2, 3])
    given = f"{one.key}_{one.stops}"
    named = row.text_input("Row", begun.row, key=f"up_row_{given}")
    try:
        named = checked_name(named, "row")
    except NameRefusedError as error:
        st.warning(sentence(error), icon=":material/error:")
        named = ""
    return SentPlace(
        row=named,
        side=side.segmented_control(
            "Side",
            sides,
            default=begun.side if begun.side in sides else sides[0],
            format_func=str.capitalize,
            required=True,
            key=f"up_side_{given}",
        )
        or sides[0],
        position_m=position.number_input(
            "First at [m]", 0.0, None, begun.position_m, 0.1, "%.2f", key=f"up_at_{given}"
        ),
        step_m=step.number_input("Step [m]", 0.0, 5.0, begun.step_m, 0.1, key=f"up_step_{given}"),
        back=way.segmented_control(
            "Walking",
            ["up", "down"],
            default="down" if begun.back else "up",
            format_func="{} the row".format,
            required=True,
            width="stretch",
            key=f"up_way_{given}",
        )
        == "down",
    )


def _show(upload: Upload) -> None:
    """Draw an upload: what is there of it, or the outcome of each of its files."""
    sending, uploads = upload.sending, resources.uploads()
    names = ", ".join(plain(one.name) for one in sending.files[:3])
    more = f" and {len(sending.files) - 3} more" if len(sending.files) > 3 else ""
    if not upload.done and not uploads.is_whole(sending.key):
        there = sum(uploads.received(sending.key))
        st.info(
            f"{names}{more}: {there / 1e6:.0f} of {sending.size / 1e6:.0f} MB are here. "
            "Choose the same files again to send the rest.",
            icon=":material/upload:",
        )
        return
    saved = sum(one.saved for one in upload.outcomes)
    left = len(upload.outcomes) - saved
    words = f"{counted(saved, 'capture', 'captures')} saved{f', {left} not' if left else ''}"
    when = round_day(upload.begun_s)
    if not upload.done:
        st.info(f"{names}{more}, {when}: being measured. {words} so far.")
    else:
        (st.success if saved else st.warning)(f"{names}{more}, {when}: {words}.")
    if saved:
        page_elements.link("results", "Results")
    lines = [
        {"File": one.name, "": "saved" if one.saved else "not saved", "Result": one.words}
        for one in sorted(upload.outcomes, key=lambda one: one.saved)
    ]
    if lines:
        page_elements.table(lines)
