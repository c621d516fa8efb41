"""Routes of both applications: JSON answers, changes by WebSocket, news."""

from __future__ import annotations

import asyncio
import json
import time
from contextlib import suppress
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, Response
from starlette.websockets import WebSocketDisconnect

from cucumbervision.errors import CucumberVisionError, DiskFullError, named_error
from cucumbervision_greenhouse import resources, round_caches
from cucumbervision_greenhouse.access import device_of
from cucumbervision_greenhouse.core_words import words_of
from cucumbervision_greenhouse.language import ask_for
from cucumbervision_greenhouse.language import gettext as _

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from starlette.requests import Request
    from starlette.websockets import WebSocket


Key = Annotated[str, Field(pattern=r"^[0-9a-f-]{36}$")]
"""Key of a round, stop or upload."""

_NEWS_S = 0.3  # interval between checks for news
_BEAT_S = 2.0


class Sent(BaseModel):
    """The content of a request; unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def answer(
    work: Callable[[Request, Any], Any],
) -> Callable[[Request], Awaitable[Response]]:
    """Make a route from a function of a request and its content, and send its result as JSON.

    A named error is answered in one line for people, with status 409, and its fault in English; a
    full disk with 507, another fault of a file with 500.
    """

    @wraps(work)
    async def route(request: Request) -> Response:
        try:
            content = await request.body() if request.method == "POST" else b""
        except HTTPException as error:  # too large or too slow, as `AccessGuard` found
            return JSONResponse({"error": error.detail}, error.status_code, error.headers)
        except ClientDisconnect:  # lost on the way, as happens among plants: nobody reads an answer
            return Response(status_code=400)
        ask_for(request.headers.get("accept-language"))
        follow_zone()
        try:
            reply = await run_in_threadpool(work, request, content)
        except CucumberVisionError as error:
            return JSONResponse({"error": words_of(error), "fault": error.message}, 409)
        except OSError as error:  # from 500 on, a part of an upload is sent again
            named = named_error(error)
            if not isinstance(named, DiskFullError):
                return JSONResponse({"error": words_of(named)}, 500)
            words = _("The computer cannot store more ({reason}): free some space on its disk")
            return JSONResponse({"error": words.format(reason=_(error.strerror or ""))}, 507)
        except ValidationError:
            return JSONResponse({"error": _("the request is damaged; reload the page")}, 400)
        if isinstance(reply, Response):
            return reply
        return JSONResponse(reply, headers={"cache-control": "no-store"})

    return route


def follow_zone() -> None:
    """Tell times in the computer's zone as it is now; Python keeps the one of the start."""
    if hasattr(time, "tzset"):  # not on Windows
        time.tzset()


def store_of(request: Request) -> Any:
    """Return the store, signed by the one who sent a request."""
    name = request.scope.get("viewer") or "dashboard"
    return resources.store().signed(name, device_of(request.cookies))


async def news(socket: WebSocket) -> None:
    """Send the news of a round as they come, while a page is open.

    Without changes they are sent again every `_BEAT_S`, so that a page can detect a dead
    connection.
    """
    sent: dict[str, Any] = {}

    def look() -> str | None:
        follow_zone()
        changes = round_caches.news(socket.query_params.get("round", ""))
        now_s = changes.pop("now_s")
        is_due = abs(now_s - sent.get("at_s", 0.0)) >= _BEAT_S
        if sent.get("last") == changes and not is_due:
            return None
        sent.update(last=changes, at_s=now_s)
        return json.dumps({**changes, "now_s": now_s})

    ask_for(socket.headers.get("accept-language"))
    await send_changes(socket, look, _NEWS_S)


async def send_changes(
    socket: WebSocket, look: Callable[[], str | bytes | None], every_s: float
) -> None:
    """Send each result of `look` once the browser has shown the last one, until it disconnects."""
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
            message = await run_in_threadpool(look) if ready.is_set() else None
            if message is not None:
                ready.clear()
                await (
                    socket.send_bytes(message)
                    if isinstance(message, bytes)
                    else socket.send_text(message)
                )
            await asyncio.wait({gone}, timeout=every_s)
    except (WebSocketDisconnect, RuntimeError):  # it disconnected while a message was sent
        pass
    finally:
        gone.cancel()
