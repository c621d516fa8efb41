"""Access control: tokens, hosts and origins, and time limits for headers and bodies."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from python_multipart.multipart import parse_options_header
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse
from uvicorn.protocols.http.h11_impl import H11Protocol

from cucumbervision.service.server import is_loopback
from cucumbervision.service.work import Problem

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from cucumbervision.service.server import ServiceSettings

REFUSALS = frozenset({401, 403})
_OPEN = frozenset({"/health"})
_TAIL_BYTES = 256  # a form's closing boundary, of 70 characters at most, and what may follow it


def problem(status: int, error: str, message: str) -> JSONResponse:
    """Return a response with the reason of a refusal."""
    return JSONResponse(Problem(error=error, message=message).model_dump(), status)


class Gate:
    """Lets requests in, before their bodies are read, and ends those that do not come on.

    Without a token only this machine is admitted, and a page of another site in its browser is
    not: `Host` must name this machine, and `Origin`, where there is one, the same place.

    Parameters
    ----------
    app : callable
        What comes behind it.
    settings : ServiceSettings
        Token and time limits.
    count : callable
        Given path, status and seconds of every request.
    """

    def __init__(
        self, app: ASGIApp, settings: ServiceSettings, count: Callable[[str, int, float], None]
    ) -> None:
        self._app, self._settings, self._count = app, settings, count

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

        try:
            refused = self._refused(scope["path"], Headers(scope=scope))
            app = self._app if refused is None else refused
            kind = Headers(scope=scope).get("content-type", "")
            await app(scope, self._limited(kind, receive), noting)
        finally:
            self._count(scope["path"], status, time.perf_counter() - began_s)

    def _refused(self, path: str, headers: Headers) -> JSONResponse | None:
        settings = self._settings
        scheme, _, token = headers.get("authorization", "").partition(" ")
        if path not in _OPEN and not settings.admits(token if scheme.lower() == "bearer" else ""):
            refused = problem(401, "AccessError", "the token is missing or wrong")
            refused.headers["WWW-Authenticate"] = "Bearer"
            return refused
        host, origin = headers.get("host", ""), headers.get("origin")
        if not settings.token and not is_loopback(urlsplit(f"//{host}").hostname or ""):
            return problem(403, "AccessError", f"the request names the host {host!r}, not this one")
        if origin is not None and urlsplit(origin).netloc != host:
            return problem(403, "AccessError", f"pages of {origin} may not send requests")
        return None

    def _limited(self, kind: str, receive: Receive) -> Receive:
        """Return what receives a body within its time, and refuses a form that is cut off."""
        settings, whole, tail = self._settings, False, b""
        until_s = time.monotonic() + settings.body_s
        boundary = parse_options_header(kind)[1].get(b"boundary", b"")

        async def limited() -> Message:
            nonlocal whole, tail
            if whole:
                return await receive()
            left_s = min(settings.silence_s, until_s - time.monotonic())
            try:
                message = await asyncio.wait_for(receive(), left_s)
            except TimeoutError:
                late = {"Connection": "close"}
                raise HTTPException(408, "the body does not come on", late) from None
            whole = not message.get("more_body", False)
            tail = (tail + message.get("body", b""))[-_TAIL_BYTES:]
            is_cut_off = boundary and b"--%b--" % boundary not in tail
            if whole and is_cut_off and message["type"] == "http.request":
                # Its parser would silently omit a truncated file.
                raise HTTPException(400, "the form is cut off; send it again")
            return message

        return limited


class HeadLimit(H11Protocol):
    """HTTP/1.1 that closes a connection on which no whole head of a request comes in time."""

    head_s = 10.0

    def connection_made(self, transport: Any) -> None:
        """Begin to wait for the first head."""
        super().connection_made(transport)
        self._await_head()

    def data_received(self, data: bytes) -> None:
        """Take data; where they are the beginning of another head, wait for its end."""
        super().data_received(data)
        self._await_head()

    def _await_head(self) -> None:
        cycle: Any = self.cycle  # the request that came last, None before the first
        if cycle is None or cycle.response_complete:
            self.loop.call_later(self.head_s, self._close_without_head, cycle)

    def _close_without_head(self, before: object) -> None:
        if self.cycle is before:
            self.transport.close()
