"""Upload: captures from other devices into a round, checked before anything reads them."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.uploading import CAMERAS, UploadOutcome, measure_uploads
from cucumbervision.dashboard.words import counted, plain
from cucumbervision.rounds.walking import NextPlace, next_place, sides_of

if TYPE_CHECKING:
    from cucumbervision.dashboard.jobs import Job
    from cucumbervision.store.views import RoundView

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
    files = st.file_uploader("Files", type=_ENDINGS, accept_multiple_files=True, key="uploads")
    place = _place(one)
    camera = st.selectbox(
        "Camera of pictures without intrinsics",
        ["", *CAMERAS],
        format_func=lambda name: name or "unknown: do not measure them",
        help="Typical figures differ from those of your camera by 1 to 2 %, and so do the lengths. "
        "Upload an intrinsics file if you have one.",
    )
    given = [(file.name, file.getvalue()) for file in files]
    # No callback: it would know the fields as they were when the page was drawn before.
    if st.button(
        "Measure these files",
        type="primary",
        icon=":material/play_arrow:",
        width="stretch",
        disabled=not files,
    ):
        _measure(one.key, given, place, camera)
    job = page_elements.finished_job("upload_job")
    if job is None:
        return
    if job.error:
        st.error(plain(job.error), icon=":material/error:")
    else:
        _outcomes(job.result)


def _place(one: RoundView) -> NextPlace:
    """Draw where the first capture was taken, for files that do not say; it goes on from there."""
    stops = resources.store().stops(one.key)
    begun, sides = next_place(stops), sides_of(stops)
    # In two lines, so that no choice is cut off on a tablet.
    row, side = st.columns(2)
    position, step, way = st.columns([2, 2, 3])
    given = f"{one.key}_{one.stops}"
    return NextPlace(
        row.text_input("Row", begun.row, key=f"up_row_{given}").strip(),
        side.segmented_control(
            "Side",
            sides,
            default=begun.side if begun.side in sides else sides[0],
            format_func=str.capitalize,
            required=True,
            key=f"up_side_{given}",
        )
        or sides[0],
        float(
            position.number_input(
                "First at [m]", 0.0, None, begun.position_m, 0.1, "%.2f", key=f"up_at_{given}"
            )
        ),
        float(step.number_input("Step [m]", 0.0, 5.0, begun.step_m, 0.1, key=f"up_step_{given}")),
        way.segmented_control(
            "Along the row",
            ["grow", "fall"],
            default="fall" if begun.back else "grow",
            format_func="Positions {}".format,
            required=True,
            width="stretch",
            key=f"up_way_{given}",
        )
        == "fall",
    )


def _outcomes(outcomes: list[UploadOutcome]) -> None:
    saved = sum(one.saved for one in outcomes)
    left = len(outcomes) - saved
    says = st.success if saved else st.warning
    says(f"{counted(saved, 'capture', 'captures')} saved{f', {left} not' if left else ''}.")
    if saved:
        page_elements.link("results", "Results")
    lines = [
        {
            "File": one.name,
            "": "saved" if one.saved else "not saved",
            "Result": one.words,
        }
        for one in sorted(outcomes, key=lambda one: one.saved)
    ]
    page_elements.table(lines)


def _measure(round_key: str, files: list[tuple[str, bytes]], place: NextPlace, camera: str) -> None:
    store, measurer = resources.store(), resources.measurer()
    options = resources.settings().options

    def work(job: Job) -> list[UploadOutcome]:
        named = [(name, io.BytesIO(data)) for name, data in files]
        found = measure_uploads(named, measurer, store, round_key, options, place, job, camera)
        resources.merge(round_key)
        return found

    page_elements.start_job("upload_job", "Measuring the uploads", work)
