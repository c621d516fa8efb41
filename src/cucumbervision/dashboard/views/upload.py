"""Upload: captures from other devices into a round, checked before anything reads them."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.measuring import measure_uploads
from cucumbervision.dashboard.plain_text import plain

if TYPE_CHECKING:
    from cucumbervision.dashboard.jobs import Job
    from cucumbervision.store.views import RoundView

__all__ = ["page"]

ENDINGS = [
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
    files = st.file_uploader("Files", type=ENDINGS, accept_multiple_files=True, key="uploads")
    spacing_m = st.number_input("Distance from one capture to the next [m]", 0.0, 5.0, 0.4, 0.1)
    given = [(file.name, file.getvalue()) for file in files]
    what = one.key, given, float(spacing_m)
    how: dict[str, Any] = {"type": "primary", "disabled": not files}
    page_elements.button(st, "Measure these files", "play_arrow", _measure, *what, **how)
    job = page_elements.finished_job("upload_job")
    if job is None:
        return
    if job.error:
        st.error(plain(job.error), icon=":material/error:")
    else:
        many = "capture" if job.result == 1 else "captures"
        st.success(f"{job.result} {many} saved; see 'Results'.", icon=":material/check:")
    for note in job.notes:
        st.warning(plain(note), icon=":material/error:")


def _measure(round_key: str, files: list[tuple[str, bytes]], spacing_m: float) -> None:
    store, measurer = resources.store(), resources.measurer()
    options = resources.settings().options

    def work(job: Job) -> int:
        named = [(name, io.BytesIO(data)) for name, data in files]
        saved = measure_uploads(named, measurer, store, round_key, options, spacing_m, job)
        resources.merge(round_key)
        return saved

    page_elements.start_job("upload_job", "Measuring the uploads", work)
