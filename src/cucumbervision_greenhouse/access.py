"""Who may open the dashboard, and how its requests are answered.

Anyone on this machine may open it; from elsewhere only with a login, which is a random token in the
link that the program prints, as in Jupyter. Accounts of an identity provider log in at a proxy in
front, which sends the token and the viewer's name.
"""

from __future__ import annotations

import hmac
import re
import secrets
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from enum import StrEnum
from functools import wraps
from typing import Annotated, Any
from urllib.parse import urlencode

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response

from cucumbervision.access import is_loopback
from cucumbervision.errors import AccessError, CucumberVisionError, DiskFullError, named_error
from cucumbervision.service.requests import RequestError, bounded, check_source
from cucumbervision_greenhouse.language import ask_for, words_of
from cucumbervision_greenhouse.language import gettext as _

COOKIE = "cucumbervision_token"
DEVICE = "cucumbervision_device"
VIEWER = "x-forwarded-email"
"""Header by which a proxy names the account that it logged in."""

_DEVICE_S = 400 * 86400  # browsers keep no cookie longer
_UNUSED = ("/_stcore/metrics", "/_stcore/agent", "/_stcore/script-health-check")
_HEADERS = {
    "x-frame-options": "SAMEORIGIN",
    "content-security-policy": "frame-ancestors 'self'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
}
# Largest body in bytes: a part of a file, the list of an upload's files, any other request.
_MOST_PART, _MOST_LIST, _MOST_ASKED = 16 * 2**20, 4 * 2**20, 256 * 2**10
_BODY_S, _SILENCE_S = 600.0, 30.0


class Login(StrEnum):
    """How viewers log in."""

    NONE = "none"
    TOKEN = "token"


_REFUSALS = {
    Login.TOKEN: "Open the link that the program printed at its start; it contains the token.",
    Login.NONE: "This dashboard is open on its own machine only, at http://localhost.",
}


def decide_login(address: str, *, always: bool = False) -> Login:
    """Return how viewers of a server log in.

    Parameters
    ----------
    address : str
        What the server binds to.
    always : bool
        Require a login on this machine too: for a server behind a proxy that others reach.

    Examples
    --------
    >>> decide_login("localhost"), decide_login("0.0.0.0")
    (<Login.NONE: 'none'>, <Login.TOKEN: 'token'>)
    """
    return Login.NONE if is_loopback(address) and not always else Login.TOKEN


def device_of(cookies: Mapping[str, str]) -> str:
    """Return the random name of a browser, by which *Undo* tells people apart; empty without one.

    It grants no access.

    Examples
    --------
    >>> device_of({"cucumbervision_device": "Zk3-x"}), device_of({"cucumbervision_device": "; a"})
    ('Zk3-x', '')
    """
    name = str(cookies.get(DEVICE, ""))
    return name if re.fullmatch(r"[\w-]{1,64}", name, re.ASCII) else ""


def is_encrypted(request: HTTPConnection) -> bool:
    """Return whether the browser uses https, also where a proxy in front of this server ends it.

    Examples
    --------
    >>> scope = {"type": "http", "scheme": "http", "headers": [(b"x-forwarded-proto", b"https")]}
    >>> is_encrypted(HTTPConnection(scope))
    True
    """
    told = request.headers.get("x-forwarded-proto", "").split(",")[0].strip().lower()
    return "https" in (request.scope.get("scheme"), told)


class AccessGuard:
    """ASGI middleware that refuses strangers before Streamlit sees their request.

    Every route and web socket passes the same checks, in this order:

    - `Host` and `Origin` must be well formed, and the request must not come from a page of another
      place, another port of the same host included (`check_source`), whatever the login.
    - Without a login only requests to a loopback name are admitted, which stops DNS rebinding.
    - With a token, its cookie; the link `?token=…` sets it. The cookie is not the token itself:
      browsers send cookies to every port of a host.
    - A proxy that logs people in sends the token as `Authorization: Bearer` instead. Who it says
      that they are (`VIEWER`) signs their corrections; from anybody else that header is removed.
    - A body is limited while it is read.

    Parameters
    ----------
    app : callable
        The ASGI application.
    login : Login
        How viewers log in.
    token : str
        The token, where that is how.
    """

    def __init__(
        self, app: Callable[..., Awaitable[None]], login: Login = Login.NONE, token: str = ""
    ) -> None:
        self._app, self._login, self._token = app, login, token

    async def __call__(
        self, scope: MutableMapping[str, Any], receive: Callable[..., Any], send: Callable[..., Any]
    ) -> None:
        """Pass a request on, redirect it, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        request, method = HTTPConnection(scope), scope.get("method", "GET")
        try:
            check_source(request.headers, method=method, local=self._login is Login.NONE)
        except (RequestError, AccessError) as error:
            status = 400 if isinstance(error, RequestError) else 403
            await _refuse(scope, receive, send, f"{error.code}: {error}", status)
            return
        scope = self._with_viewer(scope, request)
        query = dict(request.query_params)
        is_link = scope.get("method") == "GET" and self._is_token(query.pop("token", ""))
        if self._login is Login.TOKEN and is_link:
            # The token goes into a cookie, and out of the address.
            place = f"/{scope['path'].lstrip('/')}" + (f"?{urlencode(query)}" if query else "")
            answer: Response = RedirectResponse(place, 303, _HEADERS)
            cookie, safe = cookie_of(self._token), is_encrypted(request)
            answer.set_cookie(COOKIE, cookie, secure=safe, httponly=True, samesite="lax")
            await answer(scope, receive, send)
        elif not self._admits(request):
            await _refuse(scope, receive, send, _REFUSALS[self._login])
        elif scope["type"] == "websocket":
            await self._app(scope, receive, send)
        else:
            most_bytes = _most_bytes(scope["path"])
            limits = {"body_s": _BODY_S, "silence_s": _SILENCE_S}
            limited = bounded(receive, request.headers, most_bytes, **limits)
            await self._app(scope, limited, _with_headers(send, request))

    def _admits(self, request: HTTPConnection) -> bool:
        if any(unused in request.scope["path"] for unused in _UNUSED):
            return False
        if self._login is Login.NONE or self._is_proxy(request):
            return True
        return self._is_token(request.cookies.get(COOKIE, ""), cookie_of(self._token))

    def _is_proxy(self, request: HTTPConnection) -> bool:
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        return scheme.lower() == "bearer" and self._is_token(token.strip())

    def _with_viewer(
        self, scope: MutableMapping[str, Any], request: HTTPConnection
    ) -> MutableMapping[str, Any]:
        """Return a request that names its viewer only if the proxy says who that is."""
        if self._login is Login.TOKEN and self._is_proxy(request):
            return {**scope, "viewer": request.headers.get(VIEWER, "")}
        headers = [(name, value) for name, value in scope["headers"] if name != VIEWER.encode()]
        return {**scope, "headers": headers}

    def _is_token(self, sent: str, expected: str = "") -> bool:
        right = (expected or self._token).encode()
        return bool(self._token) and hmac.compare_digest(sent.encode(), right)


def cookie_of(token: str) -> str:
    """Return the cookie that grants the same access as the token, and does not reveal it.

    Examples
    --------
    >>> len(cookie_of("0123456789abcdef"))
    64
    """
    return hmac.new(token.encode(), b"cookie of the dashboard", "sha256").hexdigest()


def _most_bytes(path: str) -> int:
    """Return how large the body of a request may be."""
    if path.startswith("/api/uploads/"):
        return _MOST_PART
    return _MOST_LIST if path == "/api/uploads" else _MOST_ASKED


async def _refuse(
    scope: MutableMapping[str, Any],
    receive: Callable[..., Any],
    send: Callable[..., Any],
    words: str,
    status: int = 403,
) -> None:
    """Refuse a request, or a web socket before it is open, with an answer where the server can."""
    can_say = "websocket.http.response" in (scope.get("extensions") or {})
    # Closing answers 403; of any other answer uvicorn logs that the handshake was not completed.
    if scope["type"] == "websocket" and (status == 403 or not can_say):
        await send({"type": "websocket.close", "code": 1008})
        return
    answer = PlainTextResponse(words, status, {**_HEADERS, "connection": "close"})
    await answer(scope, receive, send)


def _with_headers(send: Callable[..., Any], request: HTTPConnection) -> Callable[..., Any]:
    """Return a sender that adds headers against framing and content sniffing to an answer.

    A page also sets the browser's random name, unless it has one.
    """

    async def send_all(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.update(_HEADERS)
            is_page = headers.get("content-type", "").startswith("text/html")
            if is_page and not device_of(request.cookies):
                named = Response()
                named.set_cookie(
                    DEVICE,
                    secrets.token_urlsafe(12),
                    max_age=_DEVICE_S,
                    secure=is_encrypted(request),
                    httponly=True,
                    samesite="strict",
                )
                headers.append("set-cookie", named.headers["set-cookie"])
        await send(message)

    return send_all


Key = Annotated[str, Field(pattern=r"^[0-9a-f-]{36}$")]
"""Key of a round, stop or upload."""


class Sent(BaseModel):
    """The content of a request; unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def answer(work: Callable[[Request, Any], Any]) -> Callable[[Request], Awaitable[Response]]:
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
