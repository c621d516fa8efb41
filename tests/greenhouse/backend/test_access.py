"""Who is admitted: by the address, by the token, and by an OpenID Connect provider's list."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

from cucumbervision.errors import AccessError
from cucumbervision_greenhouse.backend.access import (
    COOKIE,
    DEVICE,
    SESSION_S,
    TICKET,
    AccessGuard,
    Login,
    OpenIdConnect,
    cookie_of,
    decide_login,
    device_of,
    note_viewer,
    read_openid_connect,
)

AUTH = '[auth]\nredirect_uri = "https://a/oauth2callback"\ncookie_secret = "x"\n'
CLIENT = 'client_id = "a"\nclient_secret = "b"\nserver_metadata_url = "https://c"\n'
ADMITTED = '[cucumbervision]\nadmitted = ["Anna@example.org", "248289761001"]\n'
TOKEN = "a-token-of-this-test-only"


def ask(
    guard_of: tuple[Login, str],
    path: str = "/",
    *,
    query: str = "",
    kind: str = "http",
    method: str = "GET",
    extension: str = "",
    **headers: str,
) -> tuple[bool, list[dict[str, Any]]]:
    """Send a request through the guard; return whether it went on, and the answer."""
    reached, sent = [], list[dict[str, Any]]()

    async def app(*_: object) -> None:
        reached.append(True)

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    async def receive() -> None:
        pytest.fail("the body was read")

    scope: dict[str, Any] = {
        "type": kind,
        "extensions": {extension: {}} if extension else {},
        "path": path,
        "query_string": query.encode(),
        "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
    }
    if kind == "http":
        scope["method"] = method
    asyncio.run(AccessGuard(app, *guard_of)(scope, receive, send))
    return bool(reached), sent


@pytest.mark.parametrize("address", ["127.0.0.1", "localhost", "::1"])
def test_this_machine_needs_no_login_unless_asked_for(address: str) -> None:
    assert decide_login(address, oidc=True) is Login.NONE
    assert decide_login(address, oidc=True, always=True) is Login.OIDC
    assert decide_login(address, oidc=False, always=True) is Login.TOKEN


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "192.168.1.5", "greenhouse.local", ""])
def test_other_addresses_need_one(address: str) -> None:
    assert decide_login(address, oidc=False) is Login.TOKEN
    assert decide_login(address, oidc=True) is Login.OIDC


@pytest.mark.parametrize(
    ("headers", "admitted"),
    [
        ({"host": "127.0.0.1:8501"}, True),
        ({"host": "localhost:8501", "origin": "http://localhost:8501"}, True),
        ({"host": "[::1]:8501"}, True),
        ({"host": "evil.example:8501"}, False),  # a name that was rebound to this machine
        ({"host": "localhost:8501", "origin": "https://evil.example"}, False),
        ({"host": "localhost:8501", "origin": "null"}, False),
        ({}, False),
    ],
)
def test_without_a_login_only_loopback_names_are_admitted(
    headers: dict[str, str], admitted: bool
) -> None:
    assert ask((Login.NONE, ""), **headers)[0] is admitted
    reached, sent = ask((Login.NONE, ""), kind="websocket", **headers)
    assert reached is admitted
    assert admitted or sent == [{"type": "websocket.close", "code": 1008}]


@pytest.mark.parametrize("kind", ["text/html; charset=utf-8", "application/json"])
@pytest.mark.parametrize("cookie", ["", f"{DEVICE}=ana", f"{DEVICE}=a b"])
def test_a_page_gives_a_browser_a_name_of_its_own_once(kind: str, cookie: str) -> None:
    sent = list[dict[str, Any]]()

    async def app(_scope: object, _receive: object, send: Any) -> None:
        headers = [(b"content-type", kind.encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    headers = [(b"host", b"localhost"), (b"cookie", cookie.encode())]
    scope = {"type": "http", "path": "/", "method": "GET", "query_string": b"", "headers": headers}
    for _ in range(2):
        asyncio.run(AccessGuard(app)(scope, app, send))
    named = [dict(message["headers"]).get(b"set-cookie", b"").decode() for message in sent]
    if kind == "application/json" or cookie == f"{DEVICE}=ana":
        assert named == ["", ""]
    else:
        first, second = (words.split(";")[0].removeprefix(f"{DEVICE}=") for words in named)
        assert first != second
        assert device_of({DEVICE: first}) == first
        assert "HttpOnly" in named[0]


def test_the_link_sets_a_cookie_that_admits() -> None:
    guard = Login.TOKEN, TOKEN
    reached, sent = ask(guard, "/capture", query=f"token={TOKEN}&row=3", host="house:8501")
    assert not reached
    answer = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    assert (sent[0]["status"], answer["location"]) == (303, "/capture?row=3")
    assert "HttpOnly" in answer["set-cookie"]
    assert TOKEN not in answer["set-cookie"]  # other ports of the host are sent it, too
    assert "Secure" not in answer["set-cookie"]
    cookie = answer["set-cookie"].split(";")[0]
    assert ask(guard, "/capture", host="house:8501", cookie=f"other=1; {cookie}")[0]
    assert ask(guard, "/_stcore/stream", kind="websocket", cookie=cookie)[0]


@pytest.mark.parametrize("proto", ["", "http", "https", "https, http"])
def test_behind_https_the_cookie_is_sent_by_no_other_way(proto: str) -> None:
    told = {"x-forwarded-proto": proto} if proto else {}
    _, sent = ask((Login.TOKEN, TOKEN), "/", query=f"token={TOKEN}", host="house", **told)
    cookie = dict(sent[0]["headers"])[b"set-cookie"].decode()
    assert ("Secure" in cookie) == proto.startswith("https")


LOGINS = [(Login.NONE, ""), (Login.OIDC, ""), (Login.TOKEN, TOKEN)]
BROKEN = [
    "[",
    "[::1",
    "::1]",
    "[::1]x",
    "a b",
    "a/b",
    "eve@house",
    "house:x",
    "house:70000",
    "a:b:1",
]


@pytest.mark.parametrize("login", LOGINS)
@pytest.mark.parametrize("value", BROKEN)
def test_a_malformed_host_or_origin_is_refused_by_name_before_any_login(
    login: tuple[Login, str], value: str
) -> None:
    for headers in ({"host": value}, {"host": "localhost", "origin": f"http://{value}"}):
        for path in ("/", "/api/press", "/_stcore/stream", "/capture"):
            reached, sent = ask(login, path, **headers)
            assert not reached
            assert sent[0]["status"] == 400
            assert sent[1]["body"].startswith(b"RequestError: the header ")
            reached, sent = ask(login, path, kind="websocket", **headers)
            assert not reached
            assert sent == [{"type": "websocket.close", "code": 1008}]
            can_say = "websocket.http.response"
            reached, sent = ask(login, path, kind="websocket", extension=can_say, **headers)
            assert not reached
            assert sent[0]["type"] == "websocket.http.response.start"
            assert sent[0]["status"] == 400


@pytest.mark.parametrize("login", LOGINS)
@pytest.mark.parametrize("path", ["/", "/api/walk", "/_stcore/stream", "/capture/capture.js"])
def test_every_route_and_socket_refuses_pages_of_another_port(
    login: tuple[Login, str], path: str
) -> None:
    note_viewer("anna", lambda: True)
    cookie = f"{COOKIE}={cookie_of(TOKEN)}; {TICKET}=anna"
    here = {"host": "localhost:8501", "cookie": cookie}
    for kind in ("http", "websocket"):
        assert ask(login, path, kind=kind, **here)[0]
        assert ask(login, path, kind=kind, origin="http://LOCALHOST:8501", **here)[0]
        assert not ask(login, path, kind=kind, origin="http://localhost:9000", **here)[0]
        assert not ask(login, path, kind=kind, **here, **{"sec-fetch-site": "same-site"})[0]
    link = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert ask(login, path, **here, **link, **{"sec-fetch-dest": "document"})[0]
    assert not ask(login, path, **here, **link, **{"sec-fetch-dest": "iframe"})[0]
    note_viewer("anna", None)


@pytest.mark.parametrize("path", ["/", "/_stcore/health", "/_stcore/upload_file/eve/1"])
@pytest.mark.parametrize("cookie", ["", f"{COOKIE}=wrong", f"{COOKIE}=", "=;"])
def test_without_the_token_nothing_is_answered(path: str, cookie: str) -> None:
    reached, sent = ask((Login.TOKEN, TOKEN), path, cookie=cookie, query="token=wrong")
    assert not reached
    assert sent[0]["status"] == 403
    assert not ask((Login.TOKEN, TOKEN), path, kind="websocket", query=f"token={TOKEN}")[0]
    assert not ask((Login.TOKEN, ""), path, cookie=f"{COOKIE}=", query="token=")[0]


def test_the_token_leads_to_no_other_site() -> None:
    _, sent = ask((Login.TOKEN, TOKEN), "//evil.example/x", query=f"token={TOKEN}")
    assert dict(sent[0]["headers"])[b"location"] == b"/evil.example/x"


def test_with_a_provider_the_other_routes_need_the_session_of_a_viewer() -> None:
    admitted = [True]
    note_viewer("anna", lambda: admitted[0], "anna@example.org")
    for path in ("/capture", "/api/press"):
        assert not ask((Login.OIDC, ""), path)[0]
        assert not ask((Login.OIDC, ""), path, cookie=f"{TICKET}=eve")[0]
        assert ask((Login.OIDC, ""), path, cookie=f"{TICKET}=anna")[0]
    admitted[0] = False
    assert not ask((Login.OIDC, ""), "/api/preview", kind="websocket", cookie=f"{TICKET}=anna")[0]
    note_viewer("anna", None)


def test_a_page_of_another_site_sends_nothing_and_frames_nothing() -> None:
    guard, cookie = (Login.TOKEN, TOKEN), f"{COOKIE}={cookie_of(TOKEN)}"
    here = {"host": "house:8501", "cookie": cookie}
    for kind in ("http", "websocket"):
        assert ask(guard, "/api/press", kind=kind, origin="http://house:8501", **here)[0]
        assert not ask(guard, "/api/press", kind=kind, origin="http://evil.example", **here)[0]
    _, sent = ask(guard, "/", host="house:8501")
    assert (b"x-frame-options", b"SAMEORIGIN") in sent[0]["headers"]
    assert (b"x-content-type-options", b"nosniff") in sent[0]["headers"]


@pytest.mark.parametrize("login", LOGINS)
def test_routes_of_streamlit_s_that_no_page_needs_are_closed(login: tuple[Login, str]) -> None:
    cookie = f"{COOKIE}={cookie_of(TOKEN)}"
    for path in ("metrics", "agent/openapi.json", "upload_file/eve/1"):
        for base in ("", "/house"):
            asked = ask(login, f"{base}/_stcore/{path}", host="localhost", cookie=cookie)
            assert not asked[0]
    assert ask(login, "/_stcore/health", host="localhost", cookie=cookie)[0]


def test_openid_connect_must_be_complete_and_admit_somebody(tmp_path: Path) -> None:
    path = tmp_path / "secrets.toml"

    def read(text: str) -> OpenIdConnect | None:
        path.write_text(text)
        return read_openid_connect((tmp_path / "none.toml", path))

    assert read_openid_connect((path,)) is None
    assert read('other = "x"\n') is None
    one = read(AUTH + CLIENT + ADMITTED)
    assert one is not None
    assert one.providers == ()
    assert one.admitted == {"anna@example.org", "248289761001"}
    named = read(AUTH + "[auth.house]\n" + CLIENT + ADMITTED)
    assert named is not None
    assert named.providers == ("house",)
    for text, message in (
        (AUTH + ADMITTED, "has no client_id and client_secret and server_metadata_url"),
        ("[auth]\n" + CLIENT + ADMITTED, "has no redirect_uri and cookie_secret"),
        (AUTH + CLIENT, "nobody is admitted"),
        (AUTH + CLIENT + "[cucumbervision]\nadmitted = []", "nobody is admitted"),
        ("[auth", "cannot be read"),
    ):
        with pytest.raises(AccessError, match=message):
            read(text)


@pytest.mark.parametrize(
    ("claims", "admitted"),
    [
        ({"sub": "1", "email": "ANNA@example.org", "email_verified": True}, True),
        ({"sub": "248289761001"}, True),
        ({"sub": "1", "email": "anna@example.org", "email_verified": False}, False),
        ({"sub": "1", "email": "anna@example.org"}, False),
        ({"sub": "anna@example.org"}, False),
        ({"sub": "1", "email": "248289761001", "email_verified": True}, False),
        ({"sub": "1", "email": "eve@example.org", "email_verified": True}, False),
        ({}, False),
    ],
)
def test_admitted_are_verified_addresses_and_subjects(
    claims: dict[str, Any], admitted: bool, tmp_path: Path
) -> None:
    path = tmp_path / "secrets.toml"
    path.write_text(AUTH + CLIENT + ADMITTED)
    oidc = read_openid_connect((path,))
    assert oidc is not None
    assert oidc.admits({**claims, "iat": time.time()}) is admitted
    assert not oidc.admits({**claims, "iat": time.time() - SESSION_S - 1})
    assert not oidc.admits(claims)
