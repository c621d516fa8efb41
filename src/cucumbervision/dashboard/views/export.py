"""Export: a round as files, packed into one zip."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.capture.source import safe_name
from cucumbervision.dashboard import page_elements, resources
from cucumbervision.exports.build import round_tables
from cucumbervision.exports.writers import ExportFormat, write_exports

if TYPE_CHECKING:
    from cucumbervision.dashboard.jobs import Job
    from cucumbervision.store.views import RoundView

__all__ = ["show"]

FORMATS = {
    ExportFormat.XLSX: "Excel",
    ExportFormat.CSV: "CSV",
    ExportFormat.HTML: "Page to print",
    ExportFormat.PARQUET: "Parquet",
    ExportFormat.JSON: "JSON",
}


def show(one: RoundView) -> None:
    """Draw the choice of formats, and the download once it is made."""
    chosen = st.pills(
        "Formats",
        list(FORMATS),
        format_func=FORMATS.__getitem__,
        selection_mode="multi",
        default=[ExportFormat.XLSX, ExportFormat.CSV, ExportFormat.HTML],
    )
    make, load = st.columns(2)
    make.button(
        "Make the files",
        icon=":material/archive:",
        width="stretch",
        disabled=not chosen,
        on_click=_make,
        args=(one, tuple(chosen)),
    )
    job = page_elements.finished_job(f"export_{one.key}")
    if job is not None and job.error:
        st.error(job.error, icon=":material/error:")
    elif job is not None:
        path: Path = job.result
        load.download_button(
            "Download",
            data=path.read_bytes,
            file_name=f"{safe_name(one.record.name or 'round')}.zip",
            mime="application/zip",
            icon=":material/download:",
            type="primary",
            width="stretch",
        )


@st.cache_resource(show_spinner=False)
def _folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="cucumbervision-exports-"))


def _make(one: RoundView, formats: tuple[ExportFormat, ...]) -> None:
    store, rates, folder = resources.store(), resources.settings().rates, _folder()
    name, profile = resources.profile_of(one)

    def work(_: Job) -> Path:
        tables = round_tables(store, one.key, profile, profile_name=name, rates=rates)
        with tempfile.TemporaryDirectory(dir=folder) as made:
            write_exports(tables, Path(made), formats)
            return Path(shutil.make_archive(str(folder / one.key), "zip", made))

    page_elements.start_job(f"export_{one.key}", "Writing the files", work)
