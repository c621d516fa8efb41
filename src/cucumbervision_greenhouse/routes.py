"""The dashboard as an ASGI application: Streamlit's pages and our routes behind the guard."""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

import streamlit as st
from pydantic import Field
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route

from cucumbervision.access import TOKEN_VARIABLE
from cucumbervision.capture.source import safe_name
from cucumbervision.errors import CucumberVisionError
from cucumbervision_greenhouse import resources, round_view, tasks
from cucumbervision_greenhouse.access import AccessGuard, Key, Login, Sent, answer
from cucumbervision_greenhouse.camera.page import routes as capture_routes
from cucumbervision_greenhouse.exports import ExportFormat
from cucumbervision_greenhouse.exports.build import RoundTables, round_tables
from cucumbervision_greenhouse.exports.writers import render_sheet, write_exports
from cucumbervision_greenhouse.language import sentence
from cucumbervision_greenhouse.uploads import Sending


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
    return round_summary.name, tables


@answer
def _files(request: Request, _: bytes) -> Response:
    """Answer with a round's files in a new zip."""
    name, tables = _tables_of(request)
    try:
        formats = [ExportFormat(name) for name in request.query_params.getlist("formats")]
    except ValueError:
        raise HTTPException(404) from None
    with tempfile.TemporaryDirectory(prefix="cucumbervision-exports-") as folder:
        write_exports(tables, Path(folder) / "files", formats, units=resources.settings().units)
        packed = Path(shutil.make_archive(f"{folder}/packed", "zip", f"{folder}/files"))
        content = packed.read_bytes()
    file_name = quote(safe_name(name or "round"))
    told = {"content-disposition": f"attachment; filename*=UTF-8''{file_name}.zip"}
    return Response(content, media_type="application/zip", headers=told)


@answer
def _print(request: Request, _: bytes) -> Response:
    """Answer with a round's page, which the browser prints."""
    sheet = render_sheet(_tables_of(request)[1], resources.settings().units)
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


def guarded_app(login: Login) -> st.App:
    """Return the application; its other options come from `.streamlit/config.toml`."""
    token = os.environ.get(TOKEN_VARIABLE, "")
    return st.App(
        Path(__file__).with_name("pages") / "app.py",
        middleware=[Middleware(AccessGuard, login=login, token=token)],
        routes=[*routes(), *capture_routes()],
        lifespan=_prepared,
        on_script_error=_say,
    )


@asynccontextmanager
async def _prepared(_: st.App) -> AsyncGenerator[dict[str, object], None]:
    """Load pages and the newest round before the first viewer, and then the networks."""

    def prepare() -> None:
        with suppress(CucumberVisionError, ImportError):  # a page shows the reason
            import_module("cucumbervision_greenhouse.pages.app")
            tasks.prepare()
            round_view.read_ahead()
            tasks.warm_up()

    threading.Thread(target=prepare, name="preparing", daemon=True).start()
    yield {}


def _say(error: Exception) -> bool:
    """Show a named error of a callback, such as a full disk, beside the page."""
    if isinstance(error, CucumberVisionError):
        st.toast(sentence(error), icon=":material/error:", duration="long")
    return isinstance(error, CucumberVisionError)
