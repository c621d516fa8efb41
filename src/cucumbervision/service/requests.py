"""What service and dashboard check of every request: connection, origin and body."""

from __future__ import annotations

import asyncio
import logging
import re
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, ClassVar

import uvicorn
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive
from uvicorn.protocols.http.h11_impl import H11Protocol

from cucumbervision.access import is_loopback
from cucumbervision.errors import AccessError, CucumberVisionError

_MINUTE_S = 60.0
_BACKLOG = 64  # so many are accepted before any of them can be closed
_LEAVE_S = 5  # longest wait for open connections at the end
_PORTS = {"http": 80, "https": 443}
_PLACE = re.compile(
    r"((?P<scheme>\w+)://)?(?P<name>\[[0-9A-Fa-f:.]+\]|[\w.-]{1,253})(:(?P<port>\d{1,4}|[1-6]\d{4}))?",
    re.ASCII,
)
_CLOSED = {"Connection": "close"}  # what is left of the body is not read
_TAIL_BYTES = 256  # a form's closing boundary, of 70 characters at most, and what may follow it


class RequestError(CucumberVisionError):
    """A header of a request is malformed."""


def parse_place(value: str, header: str = "Host") -> tuple[str, str, int | None]:
    """Return scheme, name in lower case and port of a `Host` header or an `Origin`.

    Raises
    ------
    RequestError
        If it is malformed.

    Examples
    --------
    >>> parse_place("House:8501"), parse_place("https://[::1]", "Origin")
    (('', 'house', 8501), ('https', '::1', None))
    """
    match = _PLACE.fullmatch(value)
    port = match and match["port"] and int(match["port"])
    if match is None or (header == "Origin") != bool(match["scheme"]) or port == 0:
        fault = f"the header {header} is malformed"
        raise RequestError(fault, remedy="name a host and its port")
    return match["scheme"] or "", match["name"].strip("[]").lower(), port or None


def check_source(headers: Headers, *, method: str = "GET", local: bool = False) -> None:
    """Refuse a request from a page of another origin, including another port of the same host.

    A link to one of our pages may be anywhere: following it is allowed.

    Parameters
    ----------
    headers : Headers
        Headers of the request, or of the handshake of a web socket.
    method : str
        HTTP method; 'GET' for a web socket.
    local : bool
        Admit only a `Host` that names this machine (`localhost` or a loopback address).

    Raises
    ------
    RequestError
        If `Host` or `Origin` is malformed or repeated, or the length of the body is ambiguous.
    AccessError
        If the request comes from another origin, or is addressed to another host.
    """
    for header in ("Host", "Origin"):
        if len(headers.getlist(header)) > 1:
            raise RequestError(f"the header {header} is there twice", remedy="send it once")
    if "content-length" in headers and "transfer-encoding" in headers:
        fault = "the headers Content-Length and Transfer-Encoding contradict each other"
        raise RequestError(fault, remedy="send one of them")
    host, origin = headers.get("host", ""), headers.get("origin")
    _, name, port = parse_place(host) if host else ("", "", None)
    if local and (not name or not is_loopback(name)):
        raise AccessError(
            f"the request names the host {host!r}, not this machine", remedy="open http://localhost"
        )
    if origin is not None:
        is_opaque = origin == "null"
        scheme, source, from_port = ("", "", None) if is_opaque else parse_place(origin, "Origin")
        usual = _PORTS.get(scheme)
        if not name or (source, from_port or usual) != (name, port or usual):
            raise AccessError(
                f"pages of {origin} may not send requests", remedy="open our own page"
            )
    site, *fetched = (headers.get(f"sec-fetch-{part}", "") for part in ("site", "mode", "dest"))
    is_link = method == "GET" and fetched == ["navigate", "document"]
    if site in ("cross-site", "same-site") and not is_link:
        raise AccessError("a page of another place sent the request", remedy="open our own page")


def bounded(
    receive: Receive, headers: Headers, most_bytes: int, *, body_s: float, silence_s: float
) -> Receive:
    """Return a `receive` that limits size and time of a body, and rejects an incomplete form.

    Parameters
    ----------
    receive : callable
        Receives the body.
    headers : Headers
        Headers of the request: a body that is declared as too large is not read at all.
    most_bytes : int
        Maximum size in bytes.
    body_s, silence_s : float
        Maximum time for the whole body, and between two parts of it, seconds.

    Notes
    -----
    It raises HTTPException: 413 if a body is too large, 408 if it is too slow, 400 if it is a form
    without its end, whose last file a parser would silently omit.
    """
    until_s = time.monotonic() + body_s
    declared = headers.get("content-length", "")
    boundary = re.search(r'boundary="?([^";]+)', headers.get("content-type", ""))
    end = f"--{boundary[1]}--".encode() if boundary else b""
    read_bytes, is_whole, tail = 0, False, b""
    words = f"the body is larger than the {most_bytes / 1e6:g} MB that are taken"

    async def receive_bounded() -> Message:
        nonlocal read_bytes, is_whole, tail
        if is_whole:  # a route that waits must learn that the client left
            return await receive()
        if declared.isdecimal() and int(declared[:20]) > most_bytes:
            raise HTTPException(413, words, _CLOSED)
        try:
            left_s = min(silence_s, until_s - time.monotonic())
            message = await asyncio.wait_for(receive(), left_s)
        except TimeoutError:
            raise HTTPException(408, "the body does not come on", _CLOSED) from None
        body = message.get("body", b"")
        read_bytes, tail = read_bytes + len(body), (tail + body)[-_TAIL_BYTES:]
        if read_bytes > most_bytes:
            raise HTTPException(413, words, _CLOSED)
        is_whole = not message.get("more_body", False)
        if is_whole and end not in tail and message["type"] == "http.request":
            raise HTTPException(400, "the form is cut off; send it again")
        return message

    return receive_bounded


class HeadLimit(H11Protocol):
    """HTTP/1.1 with limits for the number of connections and for the time of a request's head.

    Where all connections are in use, the one that has waited longest for its head is closed: half
    heads exclude nobody.
    """

    head_s = 10.0
    most_connections = 512
    _headless: ClassVar[dict[HeadLimit, asyncio.TimerHandle]] = {}  # the oldest first

    def connection_made(self, transport: Any) -> None:
        """Start the timeout of the first head; close the oldest if this is one too many."""
        super().connection_made(transport)
        self._await_head()
        if len(self.connections) > self.most_connections:
            oldest = next(iter(self._headless))
            oldest._forget()
            oldest.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Process data, and start or end the timeout of a head."""
        super().data_received(data)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._forget()
        super().connection_lost(exc)

    def _await_head(self) -> None:
        cycle: Any = self.cycle  # the latest request; None before the first
        is_socket = self.transport.get_protocol() is not self
        if is_socket or (cycle is not None and not cycle.response_complete):
            self._forget()
        elif self not in self._headless:
            timer = self.loop.call_later(self.head_s, self.transport.close)
            self._headless[self] = timer

    def _forget(self) -> None:
        timer = self._headless.pop(self, None)
        if timer is not None:
            timer.cancel()


class _OnceAMinute(logging.Filter):
    """Passes a message once a minute: a flood of requests does not fill the disk."""

    def __init__(self) -> None:
        super().__init__()
        self._passed_s: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a message is written."""
        text, now_s = f"{record.msg}{record.exc_info and record.exc_info[1]!r}", time.monotonic()
        self._passed_s = {key: at for key, at in self._passed_s.items() if now_s - at < _MINUTE_S}
        return self._passed_s.setdefault(text, now_s) == now_s


def listen(
    app: ASGIApp,
    address: str,
    port: int,
    *,
    sockets: str = "none",
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Serve an application until it is interrupted.

    Parameters
    ----------
    app : callable
        The ASGI application.
    address : str
        Address to bind to.
    port : int
        TCP port.
    sockets : str
        Uvicorn's implementation of web sockets.
    ready : callable
        Called once the port is bound.

    Raises
    ------
    CucumberVisionError
        If the port cannot be bound, as where another program uses it.
    """
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        bound = socket.create_server((address, port), family=family)
    except OSError as error:
        raise CucumberVisionError(
            f"port {port} cannot be used ({error.strerror})",
            source=address,
            remedy="end the program that uses it, or choose another --port",
        ) from None
    for name in ("uvicorn.error", "asyncio"):
        logging.getLogger(name).addFilter(_OnceAMinute())
    config = uvicorn.Config(
        app,
        http=HeadLimit,
        ws=sockets,
        backlog=_BACKLOG,
        log_level="warning",
        server_header=False,
        timeout_graceful_shutdown=_LEAVE_S,
    )
    ready()
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[bound])
