"""Who may open the dashboard: anyone on this machine; from elsewhere only with a login.

Either the random token of the link that the program prints, as Jupyter has it, or an OpenID Connect
provider by Streamlit's `st.login` with a list of whom it may admit.
"""

from __future__ import annotations

import hmac
import re
import secrets
import time
import tomllib
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse, Response

from cucumbervision.access import is_loopback
from cucumbervision.errors import AccessError
from cucumbervision.service.requests import RequestError, bounded, check_source

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, MutableMapping

SESSION_S = 12 * 3600.0  # a working day; then the viewer logs in again
COOKIE = "cucumbervision_token"
TICKET = "cucumbervision_viewer"
DEVICE = "cucumbervision_device"
_DEVICE_S = 400 * 86400  # browsers keep no cookie longer
_UPLOAD = "/_stcore/upload_file"
_OWN = ("/api/", "/capture")  # routes that are none of Streamlit's, and so without its login
_UNUSED = (_UPLOAD, "/_stcore/metrics", "/_stcore/agent", "/_stcore/script-health-check")
_HEADERS = {
    "x-frame-options": "SAMEORIGIN",
    "content-security-policy": "frame-ancestors 'self'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
}
# Bytes of a body: of a part of a file, of the list of an upload's files, of all else.
_MOST_PART, _MOST_LIST, _MOST_ASKED = 16 * 2**20, 4 * 2**20, 256 * 2**10
_BODY_S, _SILENCE_S = 600.0, 30.0
_MOST_VIEWERS = 10_000  # sessions that are remembered
_OIDC_SHARED = ("redirect_uri", "cookie_secret")
_OIDC_PROVIDER = ("client_id", "client_secret", "server_metadata_url")


class Login(StrEnum):
    """How viewers log in."""

    NONE = "none"
    OIDC = "oidc"
    TOKEN = "token"


def decide_login(address: str, *, oidc: bool, always: bool = False) -> Login:
    """Return how viewers of a server log in.

    Parameters
    ----------
    address : str
        What the server binds to.
    oidc : bool
        Whether OpenID Connect is set up.
    always : bool
        Require a login on this machine too: for a server behind a proxy that others reach.

    Examples
    --------
    >>> decide_login("localhost", oidc=False), decide_login("0.0.0.0", oidc=False)
    (<Login.NONE: 'none'>, <Login.TOKEN: 'token'>)
    """
    if is_loopback(address) and not always:
        return Login.NONE
    return Login.OIDC if oidc else Login.TOKEN


@dataclass(frozen=True)
class OpenIdConnect:
    """Login by accounts of an OpenID Connect provider.

    Parameters
    ----------
    providers : tuple of str
        Names in [auth.NAME]; empty for the one provider of [auth] itself.
    admitted : frozenset of str
        E-mail addresses in lower case, and subject identifiers (`sub`), which have no '@'.
    """

    providers: tuple[str, ...]
    admitted: frozenset[str]

    def admits(self, claims: Mapping[str, Any]) -> bool:
        """Return whether an ID token is younger than `SESSION_S` and names somebody admitted.

        An e-mail address counts only if the provider says that it verified it. The token's age
        counts because Streamlit's cookie would keep the login for 30 days.

        Examples
        --------
        >>> only_anna = OpenIdConnect((), frozenset({"anna@example.org"}))
        >>> token = {"iat": time.time(), "email": "Anna@example.org"}
        >>> only_anna.admits(token | {"email_verified": True}), only_anna.admits(token)
        (True, False)
        """
        if time.time() > float(claims.get("iat") or 0) + SESSION_S:
            return False
        email, subject = str(claims.get("email", "")).lower(), str(claims.get("sub", ""))
        if "@" in email and claims.get("email_verified") is True and email in self.admitted:
            return True
        return "@" not in subject and subject in self.admitted


def read_openid_connect(files: tuple[Path, ...] | None = None) -> OpenIdConnect | None:
    """Return the login by OpenID Connect that Streamlit's secrets files set up; None for none.

    Parameters
    ----------
    files : tuple of Path, optional
        By default `~/.streamlit/secrets.toml` and `.streamlit/secrets.toml`; later ones override
        earlier ones, as in Streamlit.

    Raises
    ------
    AccessError
        If a file is not TOML, [auth] lacks a key that `st.login` needs, or [cucumbervision] has no
        list `admitted`: anyone with an account at a public provider could log in.
    """
    if files is None:
        files = tuple(at / ".streamlit" / "secrets.toml" for at in (Path.home(), Path.cwd()))
    document: dict[str, Any] = {}
    for path in files:
        try:
            document |= tomllib.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            continue
        except (OSError, ValueError, RecursionError) as error:
            raise AccessError(
                f"cannot be read ({error})", source=path, remedy="correct it"
            ) from None
    auth, own = document.get("auth"), document.get("cucumbervision")
    if auth is None:
        return None
    auth = auth if isinstance(auth, dict) else {}
    named = {name: part for name, part in auth.items() if isinstance(part, dict)}
    missing = [key for key in _OIDC_SHARED if not auth.get(key)]
    missing += [k for k in _OIDC_PROVIDER if not all(p.get(k) for p in named.values() or [auth])]
    if missing:
        raise AccessError(
            f"[auth] has no {' and '.join(missing)}",
            source="secrets.toml",
            remedy="see Streamlit's page on st.login",
        )
    admitted = own.get("admitted") if isinstance(own, dict) else None
    if not isinstance(admitted, list) or not admitted:
        raise AccessError(
            "[auth] is set up, but nobody is admitted",
            source="secrets.toml",
            remedy='add [cucumbervision] with admitted = ["name@example.org"]',
        )
    # Addresses are compared without regard to case, subject identifiers exactly.
    names = {str(one).lower() if "@" in str(one) else str(one) for one in admitted}
    return OpenIdConnect(tuple(named), frozenset(names))


def device_of(cookies: Mapping[str, str]) -> str:
    """Return a browser's own name, by which *Undo* tells people apart; empty where it has none.

    It admits to nothing.

    Examples
    --------
    >>> device_of({"cucumbervision_device": "Zk3-x"}), device_of({"cucumbervision_device": "; a"})
    ('Zk3-x', '')
    """
    name = str(cookies.get(DEVICE, ""))
    return name if re.fullmatch(r"[\w-]{1,64}", name, re.ASCII) else ""


_viewers: dict[str, tuple[Callable[[], bool], str]] = {}


def is_encrypted(request: HTTPConnection) -> bool:
    """Tell whether a browser asks by https, also where a proxy before this server answers it.

    Examples
    --------
    >>> scope = {"type": "http", "scheme": "http", "headers": [(b"x-forwarded-proto", b"https")]}
    >>> is_encrypted(HTTPConnection(scope))
    True
    """
    told = request.headers.get("x-forwarded-proto", "").split(",")[0].strip().lower()
    return "https" in (request.scope.get("scheme"), told)


def note_viewer(session: str, is_admitted: Callable[[], bool] | None, name: str = "") -> None:
    """Note who is behind a page, for what that page sends outside Streamlit's connection.

    Parameters
    ----------
    session : str
        Streamlit's identifier of the page's session, which nobody else knows; the page sends it
        as the cookie `TICKET`.
    is_admitted : callable, optional
        Whether the viewer is still logged in, asked each time; None for one who is not.
    name : str
        Who that is, for the log of corrections.
    """
    _viewers.pop(session, None)
    if is_admitted is not None:
        _viewers[session] = is_admitted, name
    while len(_viewers) > _MOST_VIEWERS:
        del _viewers[next(iter(_viewers))]


class AccessGuard:
    """ASGI middleware that refuses strangers before Streamlit sees their request.

    Every route and web socket is asked the same, in this order:

    - `Host` and `Origin` must be well formed, and the request must not come from a page of another
      place, another port of the same host included (`check_source`), whatever the login.
    - Without a login only requests to a loopback name are admitted: a name that was rebound to this
      machine operates nothing.
    - With a token, its cookie; the link `?token=…` sets it. The cookie is not the token itself:
      browsers send cookies to every port of a host.
    - With OpenID Connect, Streamlit's pages ask for the login; what is sent outside their
      connection (uploads, presses, pictures, news) needs the session of one who is logged in.
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
            await _refuse(scope, receive, send, self._refusal)
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
        if self._login is Login.TOKEN:
            return self._is_token(request.cookies.get(COOKIE, ""), cookie_of(self._token))
        return self._login is Login.NONE or self._is_logged_in(request)

    def _is_logged_in(self, request: HTTPConnection) -> bool:
        if not request.scope["path"].startswith(_OWN):
            return True
        session = request.cookies.get(TICKET, "")
        is_admitted, request.scope["viewer"] = _viewers.get(session, (None, ""))
        return is_admitted is not None and is_admitted()

    def _is_token(self, sent: str, expected: str = "") -> bool:
        right = (expected or self._token).encode()
        return bool(self._token) and hmac.compare_digest(sent.encode(), right)

    @property
    def _refusal(self) -> str:
        if self._login is Login.TOKEN:
            return "Open the link that the program printed at its start; it contains the token."
        if self._login is Login.OIDC:
            return "Log in first."
        return "This dashboard is open on its own machine only, at http://localhost."


def cookie_of(token: str) -> str:
    """Return the cookie that admits as a token does, from which the token cannot be told.

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
    """Refuse a request, or a web socket before it is open: by name where the server can."""
    can_say = "websocket.http.response" in (scope.get("extensions") or {})
    # Closing answers 403; of any other answer uvicorn logs that the handshake was not completed.
    if scope["type"] == "websocket" and (status == 403 or not can_say):
        await send({"type": "websocket.close", "code": 1008})
        return
    answer = PlainTextResponse(words, status, {**_HEADERS, "connection": "close"})
    await answer(scope, receive, send)


def _with_headers(send: Callable[..., Any], request: HTTPConnection) -> Callable[..., Any]:
    """Return what sends an answer with headers by which no other site can frame or misread it.

    A page gives a browser its name, unless it has one.
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
