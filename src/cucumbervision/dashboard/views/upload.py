"""Upload: captures from other devices into a round, checked before anything reads them."""

from __future__ import annotations

import io
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.jobs import JobState
from cucumbervision.errors import CucumberVisionError
from cucumbervision.intake.uploads import accept_uploads

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Stop
    from cucumbervision.dashboard.jobs import Job

__all__ = ["page"]

KINDS = [
    "zip",
    "bag",
    "db3",
    "png",
    "jpg",
    "jpeg",
    "tif",
    "tiff",
    "npy",
    "npz",
    "json",
    "csv",
    "raw",
]


def page() -> None:
    """Draw the page."""
    one = page_elements.pick_round()
    if one is None:
        st.info("Begin a round first: press 'New round'.", icon=":material/flag:")
        return
    st.write(
        "Zips of captures, RealSense recordings (.bag, .db3), or colour and depth pictures with "
        "matching names. Many at once."
    )
    files = st.file_uploader("Files", type=KINDS, accept_multiple_files=True, key="uploads")
    spaced = st.number_input("Metres from one capture to the next", 0.0, 5.0, 0.4, 0.1)
    st.button(
        "Measure these files",
        icon=":material/play_arrow:",
        type="primary",
        width="stretch",
        disabled=not files,
        on_click=_measure,
        args=(one.key, [(file.name, file.getvalue()) for file in files], float(spaced)),
    )
    _progress()


def _measure(round_key: str, files: list[tuple[str, bytes]], spaced_m: float) -> None:
    store, measurer, options = resources.store(), resources.measurer(), resources.options()

    def work(job: Job) -> int:
        job.total = len(files)
        folder = Path(tempfile.mkdtemp(prefix="cucumbervision-"))
        saved = 0
        try:
            named = [(name, io.BytesIO(data)) for name, data in files]
            accepted = accept_uploads(named, folder, report=lambda *_: job.step())
            for refused in accepted.refused:
                job.notes.append(str(refused.error))
            for source in accepted.sources:
                for ref in source.open(options.reading):
                    try:
                        capture = ref.load()
                    except CucumberVisionError as error:
                        job.notes.append(str(error))
                        continue
                    stop = _spot(capture.stop, saved, spaced_m)
                    taken = measurer.take_stop(
                        store, round_key, replace(capture, stop=stop), options
                    )
                    saved += 1
                    if taken.note:
                        job.notes.append(f"{capture.name}: {taken.note}")
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        resources.merge(round_key)
        return saved

    st.session_state["upload_job"] = resources.worker().submit("Measuring the uploads", work).number


def _spot(own: Stop, number: int, spaced_m: float) -> Stop:
    if own.position_m is not None:
        return own
    return replace(own, position_m=round(number * spaced_m, 2), step=number + 1)


def _progress() -> None:
    job = resources.worker().get(st.session_state.get("upload_job"))
    if job is None:
        return
    if not job.finished.is_set():
        page_elements.progress(job)
        return
    if job.state is JobState.FAILED:
        st.error(job.error, icon=":material/error:")
    else:
        many = "capture" if job.result == 1 else "captures"
        st.success(f"{job.result} {many} saved; see 'Results'.", icon=":material/check:")
    for note in job.notes:
        st.warning(note, icon=":material/error:")
