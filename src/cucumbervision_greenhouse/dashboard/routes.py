"""Routes beside Streamlit's pages: uploads, files of a round, the page to print."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

from pydantic import Field
from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route

from cucumbervision.capture.source import safe_name
from cucumbervision_greenhouse.backend import resources, tasks
from cucumbervision_greenhouse.backend.answers import Key, Sent, answer
from cucumbervision_greenhouse.backend.printed_words import printed_words
from cucumbervision_greenhouse.backend.uploads import Sending
from cucumbervision_greenhouse.exports import ExportFormat
from cucumbervision_greenhouse.exports.build import RoundTables, round_tables
from cucumbervision_greenhouse.exports.writers import render_sheet, write_exports

if TYPE_CHECKING:
    from starlette.requests import Request


class UploadPart(Sent):
    """A part of a file: the file's number in its upload, and where the part begins."""

    upload: Key
    number: int
    offset: Annotated[int, Field(ge=0)]


@answer
def _begin_upload(request: Request, content: bytes) -> Any:  # noqa: ARG001
    sending = Sending.model_validate_json(content)
    received = resources.uploads().begin(sending, resources.settings().upload_limit_mb * 1_000_000)
    return {"upload": sending.key, "received": received}


@answer
def _receive(request: Request, content: bytes) -> Any:
    part = UploadPart.model_validate({**request.path_params, **request.query_params})
    uploads = resources.uploads()
    received = uploads.append(part.upload, part.number, part.offset, content)
    if uploads.is_whole(part.upload):
        tasks.queue_uploads()
    return {"received": received}


def _tables_of(request: Request) -> tuple[str, RoundTables]:
    """Return the name and the tables of the round in the address."""
    round_summary = resources.store().round(request.path_params["round"])
    if round_summary is None:
        raise HTTPException(404)
    profile_name, profile = resources.profile_of(round_summary)
    rates = resources.settings().rates
    tables = round_tables(
        resources.store(), round_summary.key, profile, profile_name=profile_name, rates=rates
    )
    return round_summary.record.name, tables


@answer
def _files(request: Request, _: bytes) -> Response:
    """Answer with a round's files in a new zip."""
    name, tables = _tables_of(request)
    try:
        formats = [ExportFormat(name) for name in request.query_params.getlist("formats")]
    except ValueError:
        raise HTTPException(404) from None
    with tempfile.TemporaryDirectory(prefix="cucumbervision-exports-") as folder:
        write_exports(tables, Path(folder) / "files", formats, words=printed_words())
        packed = Path(shutil.make_archive(f"{folder}/packed", "zip", f"{folder}/files"))
        content = packed.read_bytes()
    file_name = quote(safe_name(name or "round"))
    told = {"content-disposition": f"attachment; filename*=UTF-8''{file_name}.zip"}
    return Response(content, media_type="application/zip", headers=told)


@answer
def _print(request: Request, _: bytes) -> Response:
    """Answer with a round's page, which the browser prints."""
    sheet = render_sheet(_tables_of(request)[1], printed_words())
    return HTMLResponse(f"{sheet}<script>print()</script>")


def routes() -> list[Route]:
    """Return the routes."""
    post = ["POST"]
    return [
        Route("/api/uploads", _begin_upload, methods=post),
        Route("/api/uploads/{upload}/{number}", _receive, methods=post),
        Route("/api/files/{round}", _files),
        Route("/api/print/{round}", _print),
    ]
