"""The gate of both servers, service and dashboard: connections, heads, origins and bodies.

`Host` and `Origin` are parsed here and nowhere else.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import re
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import uvicorn
from starlette.exceptions import HTTPException
from uvicorn.protocols.http.h11_impl import H11Protocol

from cucumbervision.access import is_loopback
from cucumbervision.errors import AccessError, CucumberVisionError

if TYPE_CHECKING:
    from starlette.datastructures import Headers
    from starlette.types import ASGIApp, Message, Receive

_PORTS = {"http": 80, "https": 443}
_LONGEST_NAME = 253
_MINUTE_S = 60.0
_LEAVE_S = 5  # longest wait for open connections at the end
_PLACE = re.compile(
    r"(?:\[(?P<v6>[0-9A-Fa-f:.]+)\]|(?P<name>[\w.-]+))(?::(?P<port>\d{0,5}))?", re.A
)
_ORIGIN = re.compile(r"(?P<scheme>[a-z][a-z0-9+.-]*)://(?P<place>[^/?#@\s]+)", re.I | re.A)
_CLOSED = {"Connection": "close"}  # what is left of the body is not read


class RequestError(CucumberVisionError):
    """A header of a request is malformed."""


@dataclass(frozen=True)
class Place:
    """A host name in lower case, without brackets, and its port; None if it has none."""

    name: str
    port: int | None = None

    def is_at(self, place: Place, scheme: str) -> bool:
        """Return whether both are the same place; the default port is that of the scheme."""
        usual = _PORTS.get(scheme)
        return (self.name, self.port or usual) == (place.name, place.port or usual)


def parse_place(value: str, header: str = "Host") -> Place:
    """Parse a `Host` header, or the part of an `Origin` after the scheme.

    Raises
    ------
    RequestError
        If it is malformed.

    Examples
    --------
    >>> parse_place("House:8501"), parse_place("[::1]")
    (Place(name='house', port=8501), Place(name='::1', port=None))
    >>> parse_place("[::1")
    Traceback (most recent call last):
    ...
    cucumbervision.service.requests.RequestError: the header Host is malformed; ...
    """
    match = _PLACE.fullmatch(value)
    malformed = RequestError(f"the header {header} is malformed", remedy="name a host and its port")
    if match is None or len(value) > _LONGEST_NAME:
        raise malformed
    port = int(match["port"]) if match["port"] else None
    try:
        name = match["name"] or str(ipaddress.IPv6Address(match["v6"]))
    except ValueError:
        raise malformed from None
    if port is not None and not 0 < port < 1 << 16:
        raise malformed
    return Place(name.lower(), port)


def parse_origin(value: str) -> tuple[str, Place] | None:
    """Return scheme and place of an `Origin`; None for 'null', an opaque origin.

    Raises
    ------
    RequestError
        If it is malformed.

    Examples
    --------
    >>> parse_origin("https://house.example")
    ('https', Place(name='house.example', port=None))
    """
    if value == "null":
        return None
    match = _ORIGIN.fullmatch(value)
    if match is None:
        raise RequestError("the header Origin is malformed", remedy="name a scheme and a host")
    return match["scheme"].lower(), parse_place(match["place"], "Origin")


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
    place = parse_place(host) if host else None
    source = None if origin is None else parse_origin(origin)
    if local and (place is None or not is_loopback(place.name)):
        raise AccessError(
            f"the request names the host {host!r}, not this machine", remedy="open http://localhost"
        )
    if origin is not None and (
        source is None or place is None or not source[1].is_at(place, source[0])
    ):
        raise AccessError(f"pages of {origin} may not send requests", remedy="open our own page")
    fetched = [headers.get(f"sec-fetch-{name}", "") for name in ("site", "mode", "dest")]
    is_link = method == "GET" and fetched[1:] == ["navigate", "document"]
    if fetched[0] in ("cross-site", "same-site") and not is_link:
        raise AccessError("a page of another place sent the request", remedy="open our own page")


def bounded(
    receive: Receive, headers: Headers, most_bytes: int, *, body_s: float, silence_s: float
) -> Receive:
    """Return a `receive` that limits the size and the time of a body while it is read.

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
    A body that is too large raises HTTPException 413, one that is too slow 408.
    """
    until_s = time.monotonic() + body_s
    told = headers.get("content-length", "")
    read_bytes, is_whole = 0, False

    async def receive_bounded() -> Message:
        nonlocal read_bytes, is_whole
        if is_whole:  # a route that waits must learn that the client left
            return await receive()
        if told.isdecimal() and int(told[:20]) > most_bytes:
            raise _too_large(most_bytes)
        try:
            left_s = min(silence_s, until_s - time.monotonic())
            message = await asyncio.wait_for(receive(), left_s)
        except TimeoutError:
            raise HTTPException(408, "the body does not come on", _CLOSED) from None
        read_bytes += len(message.get("body", b""))
        if read_bytes > most_bytes:
            raise _too_large(most_bytes)
        is_whole = not message.get("more_body", False)
        return message

    return receive_bounded


def _too_large(most_bytes: int) -> HTTPException:
    words = f"the body is larger than the {most_bytes / 1e6:g} MB that are taken"
    return HTTPException(413, words, _CLOSED)


class HeadLimit(H11Protocol):
    """HTTP/1.1 with limits for the number of connections and for the time of a request's head.

    Where all connections are in use, the one that has waited longest for its head is closed: half
    heads exclude nobody.
    """

    head_s = 10.0
    most_connections = 512
    _headless: ClassVar[dict[HeadLimit, asyncio.TimerHandle]] = {}  # the oldest first

    def connection_made(self, transport: Any) -> None:
        """Start the timeout of the first head, or close a connection that is one too many."""
        super().connection_made(transport)
        self._await_head()
        if len(self.connections) > self.most_connections:
            self.logger.warning("too many connections: those without a request are closed")
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

    def send_400_response(self, msg: str) -> None:
        """Refuse a malformed request; who answers its first part is told that the client left."""
        cycle: Any = self.cycle
        if cycle is not None and not cycle.response_complete:
            cycle.disconnected = True
            cycle.message_event.set()
        if cycle is not None and cycle.response_started:
            self.transport.close()
        else:
            super().send_400_response(msg)

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


def listen(app: ASGIApp, address: str, port: int, *, sockets: str = "none") -> None:
    """Serve an application until it is interrupted, with `HeadLimit`.

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
    """
    descriptors = 1024
    try:
        import resource

        descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    except ImportError:  # Windows
        pass
    # One pass of the event loop accepts as many as `backlog`, before any of them can be refused.
    backlog = max(min(descriptors // 16, 128), 8)
    HeadLimit.most_connections = min(descriptors // 2, 4096)
    for name in ("uvicorn.error", "asyncio"):
        logging.getLogger(name).addFilter(_OnceAMinute())
    uvicorn.run(
        app,
        host=address,
        port=port,
        http=HeadLimit,
        ws=sockets,
        backlog=backlog,
        log_level="warning",
        server_header=False,
        timeout_graceful_shutdown=_LEAVE_S,
    )
