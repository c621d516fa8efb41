"""Access control: tokens, origins of requests, a full queue, limits for headers and bodies."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from python_multipart.multipart import parse_options_header
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse

from cucumbervision.errors import AccessError
from cucumbervision.service.requests import RequestError, bounded, check_source
from cucumbervision.service.work import BusyError, Problem

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractContextManager

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from cucumbervision.service.server import ServiceSettings

REFUSALS = frozenset({401, 403})
_OPEN = frozenset({"/health"})
_WITH_BODY = frozenset({"/measure", "/detect"})
_BODY_SLACK = 1_000_000  # part headers of a body with many files
_TAIL_BYTES = 256  # a form's closing boundary, of 70 characters at most, and what may follow it


_STATUS = {RequestError: 400, AccessError: 403, BusyError: 503}


def problem(status: int, error: str, message: str) -> JSONResponse:
    """Return a response with the reason of a refusal."""
    return JSONResponse(Problem(error=error, message=message).model_dump(), status)


class Gate:
    """Admits or refuses a request before its body is read, and ends requests that stall.

    Without a token, only requests to a name of this machine are admitted. A page of another origin
    is refused, even with the token (`check_source`). A request that finds the queue full is refused
    before its body is read.

    Parameters
    ----------
    app : callable
        The application that answers admitted requests.
    settings : ServiceSettings
        Token and time limits.
    count : callable
        Called with path, status and seconds of every request.
    place : callable
        Context manager that holds a place in the queue; raises BusyError if it is full.
    """

    def __init__(
        self,
        app: ASGIApp,
        settings: ServiceSettings,
        count: Callable[[str, int, float], None],
        place: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self._app, self._settings, self._count, self._place = app, settings, count, place

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began_s, status = time.perf_counter(), 500

        async def noting(message: Message) -> None:
            nonlocal status
            status = message.get("status", status)
            await send(message)

        headers, path = Headers(scope=scope), scope["path"]
        try:
            check_source(headers, method=scope["method"], local=not self._settings.token)
            if path not in _OPEN and not self._is_admitted(headers):
                await _without_token()(scope, receive, noting)
            elif path in _WITH_BODY and scope["method"] == "POST":
                with self._place():
                    await self._app(scope, self._limited(headers, receive), noting)
            else:
                most_bytes = 0  # the body is not read
                await self._app(scope, self._bounded(headers, receive, most_bytes), noting)
        except (RequestError, AccessError, BusyError) as error:
            refused = problem(_STATUS[type(error)], error.code, str(error))
            refused.headers.update({"Connection": "close"})
            if isinstance(error, BusyError):
                refused.headers["Retry-After"] = "1"
            await refused(scope, receive, noting)
        finally:
            self._count(path, status, time.perf_counter() - began_s)

    def _is_admitted(self, headers: Headers) -> bool:
        scheme, _, token = headers.get("authorization", "").partition(" ")
        return self._settings.admits(token if scheme.lower() == "bearer" else "")

    def _bounded(self, headers: Headers, receive: Receive, most_bytes: int) -> Receive:
        settings = self._settings
        times = {"body_s": settings.body_s, "silence_s": settings.silence_s}
        return bounded(receive, headers, most_bytes, **times)

    def _limited(self, headers: Headers, receive: Receive) -> Receive:
        """Return a `receive` that enforces the limits of a body and refuses a truncated form."""
        most_bytes = self._settings.limits.total_bytes + _BODY_SLACK
        receive, is_complete, tail = self._bounded(headers, receive, most_bytes), False, b""
        kind = headers.get("content-type", "")
        boundary = parse_options_header(kind)[1].get(b"boundary", b"")

        async def limited() -> Message:
            nonlocal is_complete, tail
            message = await receive()
            if is_complete:
                return message
            is_complete = not message.get("more_body", False)
            tail = (tail + message.get("body", b""))[-_TAIL_BYTES:]
            is_cut_off = boundary and b"--%b--" % boundary not in tail
            if is_complete and is_cut_off and message["type"] == "http.request":
                # Its parser would silently omit a truncated file.
                raise HTTPException(400, "the form is cut off; send it again")
            return message

        return limited


def _without_token() -> JSONResponse:
    refused = problem(401, "AccessError", "the token is missing or wrong")
    refused.headers["WWW-Authenticate"] = "Bearer"
    return refused
