"""Routes beside Streamlit's pages: the capture page, its pictures and presses, news for all pages.

Capture is used while walking, where a connection drops: it is a page of its own, of plain modules.
News and pictures come by WebSocket: of other lasting connections a browser opens six, and a seventh
page would wait for ever.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import struct
import tempfile
import time
from contextlib import suppress
from functools import lru_cache, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import quote

import cv2
import numpy as np
import streamlit
import streamlit as st
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocketDisconnect

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.source import safe_name
from cucumbervision.errors import CucumberVisionError, NameRefusedError
from cucumbervision_greenhouse.backend import resources
from cucumbervision_greenhouse.backend.access import device_of
from cucumbervision_greenhouse.backend.fruit_pictures import (
    PICTURE_FILES,
    as_jpeg,
    depth_picture,
    scale_bar,
)
from cucumbervision_greenhouse.backend.uploads import Sending
from cucumbervision_greenhouse.capture_page import state
from cucumbervision_greenhouse.capture_page.shutter import Press, Shutter
from cucumbervision_greenhouse.exports import ExportFormat
from cucumbervision_greenhouse.exports.build import round_tables
from cucumbervision_greenhouse.exports.writers import write_exports
from cucumbervision_greenhouse.store.records import Round

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from numpy.typing import NDArray
    from starlette.requests import Request
    from starlette.websockets import WebSocket

    from cucumbervision_greenhouse.backend.camera_feed import Preview
    from cucumbervision_greenhouse.capture_page.shutter import Pressed

PAGES = ("", "upload", "results", "map", "forecast", "accuracy", "settings", "about")
"""Addresses of Streamlit's pages."""

_STATIC = Path(__file__).with_name("static")
_NEWS_S = 0.3  # how often is looked for news
_BEAT_S = 2.0
_LOOK_S = 0.03  # how often is looked for a new picture
_PREVIEW_PX = 640
_STILL_PX, _STILL_LEVELS = (64, 36), 3  # a camera's noise is less, in blocks of so many
_PRESS_S = 4.0  # how long an answer to presses is held back until they are saved
_MOST_TOGETHER = 50  # presses in one request

Key = Annotated[str, Field(pattern=r"^[0-9a-f-]{36}$")]
Source = Literal["camera", "replay"]
Moment = Annotated[float, Field(ge=0, lt=4_102_444_800)]
"""Seconds since the epoch, before the year 2100."""


class _Sent(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class SentPress(_Sent):
    """A press as a browser sends it: its number, its moment by this machine's clock, its place."""

    number: Annotated[str, Field(pattern=r"^[\w-]{1,64}$")]
    at_s: Moment
    round: Key
    source: Source
    row: Annotated[str, Field(max_length=100)] = ""
    side: Annotated[str, Field(max_length=100)] = "left"
    position_m: Annotated[float, Field(ge=0, le=10_000)]


class SentPresses(_Sent):
    """Presses that are sent together."""

    presses: Annotated[list[SentPress], Field(max_length=_MOST_TOGETHER)]


class SentRound(_Sent):
    """A round to be begun."""

    name: Annotated[str, Field(max_length=200)] = ""
    house: Annotated[str, Field(max_length=200)] = ""


class SentUndo(_Sent):
    """What a browser takes back: the last thing that it did in a round.

    That is its last press (the stop, and when it was pressed), unless it did something since.
    """

    stop: Key | None = None
    at_s: Moment | None = None
    round: Key | None = None


class UploadPart(_Sent):
    """A part of a file: the file's number in its upload, and where the part begins."""

    upload: Key
    number: int
    offset: Annotated[int, Field(ge=0)]


class SentFruit(_Sent):
    """A point in a missed fruit, or a box around it, in pixels of its capture."""

    stop: Key
    capture: Annotated[str, Field(max_length=500)]
    point: tuple[float, float] | None = None
    box: tuple[float, float, float, float] | None = None

    @model_validator(mode="after")
    def _names_a_place(self) -> SentFruit:
        if self.point is None and self.box is None:
            raise ValueError("neither a point nor a box")
        return self


@st.cache_resource(show_spinner=False)
def _shutter() -> Shutter:
    """Return what takes the pictures of all viewers."""
    return Shutter(resources.store(), resources.waiting(), resources.wake)


def _answer(
    work: Callable[[Request, Any], Any],
) -> Callable[[Request], Awaitable[Response]]:
    """Make a route of a function of a request and its content; what it returns is sent as JSON.

    An error of ours is answered in one line for people, by the status 409.
    """

    @wraps(work)
    async def route(request: Request) -> Response:
        try:
            content = await request.body() if request.method == "POST" else b""
        except HTTPException as error:  # too large, or it does not come on: `AccessGuard` says so
            return JSONResponse({"error": error.detail}, error.status_code, error.headers)
        try:
            found = await run_in_threadpool(work, request, content)
        except CucumberVisionError as error:
            return JSONResponse({"error": str(error)}, 409)
        except ValidationError:
            return JSONResponse({"error": "the request is damaged; reload the page"}, 400)
        if isinstance(found, Response):
            return found
        return JSONResponse(found, headers={"cache-control": "no-store"})

    return route


@_answer
def _walk(request: Request, _: bytes) -> Any:
    asked = request.query_params
    return state.walk(_store_of(request), asked.get("round", ""), asked.get("source", ""))


@_answer
def _press(request: Request, content: bytes) -> Any:  # noqa: ARG001
    sent = SentPresses.model_validate_json(content).presses
    burst, known = resources.settings().burst, {one.key for one in resources.rounds()}
    taken: list[Pressed | str | None] = []
    for one in sent:  # all at once, so that none waits for another's last frames
        try:
            stop = Stop(one.row.strip() or None, one.side or None, one.position_m)
        except NameRefusedError as error:
            taken.append(str(error))
            continue
        press = Press(one.number, one.at_s)
        if one.round not in known:
            taken.append("the round was deleted")
            continue
        feed = resources.feed(one.source)
        taken.append(_shutter().press(feed, burst, one.round, stop, press))
    until_s = time.monotonic() + _PRESS_S
    return {
        "presses": [
            {"number": one.number, **state.outcome(pressed, until_s - time.monotonic())}
            for one, pressed in zip(sent, taken, strict=True)
        ]
    }


@_answer
def _begin(request: Request, content: bytes) -> Any:
    sent = SentRound.model_validate_json(content)
    profile = resources.settings().profile
    record = Round(name=sent.name, house=sent.house, profile=profile)
    _store_of(request).save_round(record)
    return {"round": record.key}


@_answer
def _undo(request: Request, content: bytes) -> Any:
    return state.take_back(_store_of(request), SentUndo.model_validate_json(content))


@_answer
def _add_fruit(request: Request, content: bytes) -> Any:
    sent = SentFruit.model_validate_json(content)
    return state.add_fruit(_store_of(request), sent)


@_answer
def _outline(request: Request, content: bytes) -> Any:  # noqa: ARG001
    sent = SentFruit.model_validate_json(content)
    return state.outline(sent)


@_answer
def _begin_upload(request: Request, content: bytes) -> Any:  # noqa: ARG001
    sending = Sending.model_validate_json(content)
    received = resources.uploads().begin(sending, resources.settings().upload_limit_mb * 1_000_000)
    return {"upload": sending.key, "received": received}


@_answer
def _receive(request: Request, content: bytes) -> Any:
    part = UploadPart.model_validate({**request.path_params, **request.query_params})
    uploads = resources.uploads()
    try:
        there = uploads.append(part.upload, part.number, part.offset, content)
    except OSError as error:  # a full disk: it is sent again until there is room
        words = f"The computer cannot store more ({error.strerror}): free some space on its disk"
        return JSONResponse({"error": words}, 507)
    if uploads.is_whole(part.upload):
        resources.measure_uploads()
    return {"received": there}


@_answer
def _retry(request: Request, content: bytes) -> Any:  # noqa: ARG001
    resources.camera().retry()
    return {}


@_answer
def _picture(request: Request, _: bytes) -> Any:
    stop, name = request.path_params["stop"], request.path_params["capture"]
    taken = {one.name: one for one in resources.store().stop(stop).captures}.get(name)
    if taken is None or taken.color is None:
        raise HTTPException(404)
    picture = as_jpeg(resources.store().images.read_color(taken.color))
    kept = {"cache-control": "private, max-age=86400, immutable"}
    return Response(picture, media_type="image/jpeg", headers=kept)


@_answer
def _files(request: Request, _: bytes) -> Response:
    """Answer with a round's files in a zip, made anew."""
    one = next((x for x in resources.rounds() if x.key == request.path_params["round"]), None)
    if one is None:
        raise HTTPException(404)
    try:
        formats = [ExportFormat(name) for name in request.query_params.getlist("formats")]
    except ValueError:
        raise HTTPException(404) from None
    profile_name, profile = resources.profile_of(one)
    rates = resources.settings().rates
    tables = round_tables(
        resources.store(), one.key, profile, profile_name=profile_name, rates=rates
    )
    with tempfile.TemporaryDirectory(prefix="cucumbervision-exports-") as folder:
        write_exports(tables, Path(folder) / "files", formats)
        packed = Path(shutil.make_archive(f"{folder}/packed", "zip", f"{folder}/files"))
        content = packed.read_bytes()
    name = safe_name(one.record.name or "round")
    told = {"content-disposition": f"attachment; filename*=UTF-8''{quote(name)}.zip"}
    return Response(content, media_type="application/zip", headers=told)


def _store_of(request: Request) -> Any:
    name = request.scope.get("viewer") or "dashboard"
    return resources.store().signed(name, device_of(request.cookies))


async def _news(socket: WebSocket) -> None:
    """Send the news of a round as they come, for as long as a page looks.

    The same ones are sent again every `_BEAT_S`, by which a page knows that its line is not dead.
    """
    known: dict[str, Any] = {}

    def look() -> str | None:
        found = resources.news(socket.query_params.get("round", ""))
        now_s = found.pop("now_s")
        is_due = abs(now_s - known.get("at_s", 0.0)) >= _BEAT_S
        if known.get("last") == found and not is_due:
            return None
        known.update(last=found, at_s=now_s)
        return json.dumps({**found, "now_s": now_s})

    await _send_changes(socket, look, _NEWS_S)


async def _preview(socket: WebSocket) -> None:
    """Send a feed's pictures, each when the one before was shown, and only where they change."""
    kind: Any = "replay" if socket.query_params.get("source") == "replay" else "camera"
    shown = Shown()

    def look() -> bytes | None:
        try:
            seen = resources.feed(kind).preview()
        except CucumberVisionError as error:
            return _framed({"state": "absent", "message": str(error)}) if shown.fails() else None
        return encoded(seen) if shown.changes(seen) else None

    await _send_changes(socket, look, _LOOK_S)


class Shown:
    """What a viewer saw last, to tell whether a new picture shows anything else."""

    def __init__(self) -> None:
        self._state: tuple[object, ...] = ()
        self._small: NDArray[np.uint8] | None = None

    def fails(self) -> bool:
        """Return whether it is news that there is nothing to see."""
        before, self._state = self._state, ("failed",)
        return before != self._state

    def changes(self, seen: Preview) -> bool:
        """Return whether a picture differs from the one before by more than a camera's noise."""
        words = None if seen.quality is None else seen.quality.advice
        state = seen.state, words, seen.message
        if seen.capture is None:
            changed = state != self._state
        else:
            size = _STILL_PX
            small = cv2.resize(seen.capture.color[::4, ::4], size, interpolation=cv2.INTER_AREA)
            before, changed = self._small, state != self._state
            if before is None or before.shape != small.shape:
                changed = True
            elif not changed:
                levels = np.abs(small.astype(np.int16) - before.astype(np.int16)).max()
                changed = int(levels) > _STILL_LEVELS
            if changed:
                self._small = np.asarray(small, np.uint8)
        self._state = state
        return changed


@lru_cache(maxsize=4)  # one for all viewers
def encoded(seen: Preview) -> bytes:
    """Return a preview as a message: the header's length, the header as JSON, colour, depth.

    Two JPEGs follow the header where there is a picture; it gives the first one's length.
    """
    header: dict[str, Any] = {"state": seen.state, "message": seen.message}
    capture, quality = seen.capture, seen.quality
    if capture is None:
        return _framed(header)
    color = as_jpeg(capture.color, _PREVIEW_PX)
    units = resources.settings().units
    depth, words = depth_picture(capture.depth_m[::2, ::2], units)
    near = None if quality is None else quality.distance_m
    header |= {
        "color_bytes": len(color),
        "size": [capture.width, capture.height],
        "name": capture.name,
        "simulated": capture.simulated,
        "depth": words,
        "bar": scale_bar(capture.intrinsics, near, units),
    }
    if quality is not None:
        header["quality"] = {
            "seen": f"{100 * quality.fill:.0f} %",
            "distance": units.text(quality.distance_m),
            "verdict": quality.verdict,
            "advice": quality.advice,
        }
    return _framed(header, color, as_jpeg(depth, _PREVIEW_PX))


def _framed(header: dict[str, Any], *parts: bytes) -> bytes:
    words = json.dumps(header).encode()
    return b"".join((struct.pack("<I", len(words)), words, *parts))


async def _send_changes(
    socket: WebSocket, look: Callable[[], str | bytes | None], every_s: float
) -> None:
    """Send what `look` finds whenever the browser has shown what came before, until it leaves."""
    await socket.accept()
    ready = asyncio.Event()
    ready.set()

    async def listen() -> None:
        with suppress(WebSocketDisconnect):
            while True:
                await socket.receive_text()
                ready.set()

    gone = asyncio.create_task(listen())
    try:
        while not gone.done():
            found = await run_in_threadpool(look) if ready.is_set() else None
            if found is not None:
                ready.clear()
                await (
                    socket.send_bytes(found)
                    if isinstance(found, bytes)
                    else socket.send_text(found)
                )
            await asyncio.wait({gone}, timeout=every_s)
    except (WebSocketDisconnect, RuntimeError):  # it left while something was sent
        pass
    finally:
        gone.cancel()


async def _capture_page(_: Request) -> Response:
    return FileResponse(_STATIC / "capture.html", headers={"cache-control": "no-cache"})


async def _static(request: Request) -> Response:
    """Answer with a file of ours; never one of another folder."""
    name = request.path_params["name"]
    path = (PICTURE_FILES if name.startswith("picture.") else _STATIC) / name
    if path.parent not in {PICTURE_FILES, _STATIC} or not path.is_file():
        raise HTTPException(404)
    # The worker that keeps the page for a lost connection lies below the page that it keeps.
    headers = {"cache-control": "no-cache", "service-worker-allowed": "/capture"}
    return FileResponse(path, headers=headers)


@lru_cache(maxsize=1)
def _index() -> str:
    """Return Streamlit's own first page, told where its server is.

    It would look for it below the page's address first: requests that fail in the console.
    """
    text = (Path(streamlit.__file__).parent / "static/index.html").read_text(encoding="utf-8")
    told = "<script>window.__streamlit = {BACKEND_BASE_URL: location.origin}</script>"
    title = "<title>CucumberVision</title>"
    return text.replace("<title>Streamlit</title>", title).replace("<head>", f"<head>{told}", 1)


async def _streamlit_page(_: Request) -> Response:
    return HTMLResponse(_index(), headers={"cache-control": "no-cache"})


def routes() -> list[Route | WebSocketRoute]:
    """Return the routes, which come before Streamlit's own."""
    post = ["POST"]
    return [
        *(Route(f"/{page}", _streamlit_page) for page in PAGES),
        Route("/capture", _capture_page),
        Route("/capture/{name}", _static),
        Route("/api/walk", _walk),
        Route("/api/press", _press, methods=post),
        Route("/api/rounds", _begin, methods=post),
        Route("/api/undo", _undo, methods=post),
        Route("/api/fruit", _add_fruit, methods=post),
        Route("/api/outline", _outline, methods=post),
        Route("/api/uploads", _begin_upload, methods=post),
        Route("/api/uploads/{upload}/{number}", _receive, methods=post),
        Route("/api/camera", _retry, methods=post),
        Route("/api/files/{round}", _files),
        Route("/api/picture/{stop}/{capture:path}", _picture),
        WebSocketRoute("/api/preview", _preview),
        WebSocketRoute("/api/news", _news),
    ]
