"""Who is admitted: by the address, by the token, and by a proxy that logs people in."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import pytest

pytest.importorskip("streamlit")

from tests.greenhouse.conftest import WALK

from cucumbervision.capture.source import example_captures
from cucumbervision.methods.result import MethodName
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse import access
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.store.repository import open_store

TOKEN = "a-token-of-this-test-only"


def ask(
    guard_of: tuple[access.Login, str],
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
    asyncio.run(access.AccessGuard(app, *guard_of)(scope, receive, send))
    return bool(reached), sent


@pytest.mark.parametrize("address", ["127.0.0.1", "localhost", "::1"])
def test_this_machine_needs_no_login_unless_asked_for(address: str) -> None:
    assert access.decide_login(address) is access.Login.NONE
    assert access.decide_login(address, always=True) is access.Login.TOKEN


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "192.168.1.5", "greenhouse.local", ""])
def test_other_addresses_need_one(address: str) -> None:
    assert access.decide_login(address) is access.Login.TOKEN


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
    assert ask((access.Login.NONE, ""), **headers)[0] is admitted
    reached, sent = ask((access.Login.NONE, ""), kind="websocket", **headers)
    assert reached is admitted
    assert admitted or sent == [{"type": "websocket.close", "code": 1008}]


@pytest.mark.parametrize("kind", ["text/html; charset=utf-8", "application/json"])
@pytest.mark.parametrize("cookie", ["", f"{access.DEVICE}=ana", f"{access.DEVICE}=a b"])
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
        asyncio.run(access.AccessGuard(app)(scope, app, send))
    named = [dict(message["headers"]).get(b"set-cookie", b"").decode() for message in sent]
    if kind == "application/json" or cookie == f"{access.DEVICE}=ana":
        assert named == ["", ""]
    else:
        first, second = (words.split(";")[0].removeprefix(f"{access.DEVICE}=") for words in named)
        assert first != second
        assert access.device_of({access.DEVICE: first}) == first
        assert "HttpOnly" in named[0]


def test_the_link_sets_a_cookie_that_admits() -> None:
    guard = access.Login.TOKEN, TOKEN
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
    _, sent = ask((access.Login.TOKEN, TOKEN), "/", query=f"token={TOKEN}", host="house", **told)
    cookie = dict(sent[0]["headers"])[b"set-cookie"].decode()
    assert ("Secure" in cookie) == proto.startswith("https")


LOGINS = [(access.Login.NONE, ""), (access.Login.TOKEN, TOKEN)]
BROKEN = [
    *("[", "[::1", "::1]", "[::1]x", "a b", "a/b", "eve@house", "house:x", "house:70000", "a:b:1")
]


@pytest.mark.parametrize("login", LOGINS)
@pytest.mark.parametrize("value", BROKEN)
def test_a_malformed_host_or_origin_is_refused_by_name_before_any_login(
    login: tuple[access.Login, str], value: str
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
    login: tuple[access.Login, str], path: str
) -> None:
    here = {"host": "localhost:8501", "cookie": f"{access.COOKIE}={access.cookie_of(TOKEN)}"}
    for kind in ("http", "websocket"):
        assert ask(login, path, kind=kind, **here)[0]
        assert ask(login, path, kind=kind, origin="http://LOCALHOST:8501", **here)[0]
        assert not ask(login, path, kind=kind, origin="http://localhost:9000", **here)[0]
        assert not ask(login, path, kind=kind, **here, **{"sec-fetch-site": "same-site"})[0]
    link = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert ask(login, path, **here, **link, **{"sec-fetch-dest": "document"})[0]
    assert not ask(login, path, **here, **link, **{"sec-fetch-dest": "iframe"})[0]


@pytest.mark.parametrize("path", ["/", "/_stcore/health", "/_stcore/upload_file/eve/1"])
@pytest.mark.parametrize("cookie", ["", f"{access.COOKIE}=wrong", f"{access.COOKIE}=", "=;"])
def test_without_the_token_nothing_is_answered(path: str, cookie: str) -> None:
    reached, sent = ask((access.Login.TOKEN, TOKEN), path, cookie=cookie, query="token=wrong")
    assert not reached
    assert sent[0]["status"] == 403
    assert not ask((access.Login.TOKEN, TOKEN), path, kind="websocket", query=f"token={TOKEN}")[0]
    assert not ask((access.Login.TOKEN, ""), path, cookie=f"{access.COOKIE}=", query="token=")[0]


def test_the_token_leads_to_no_other_site() -> None:
    _, sent = ask((access.Login.TOKEN, TOKEN), "//evil.example/x", query=f"token={TOKEN}")
    assert dict(sent[0]["headers"])[b"location"] == b"/evil.example/x"


@pytest.mark.parametrize(
    ("login", "authorization", "viewer"),
    [
        ((access.Login.TOKEN, TOKEN), f"Bearer {TOKEN}", "anna@example.org"),
        ((access.Login.TOKEN, TOKEN), f"bearer  {TOKEN}", "anna@example.org"),
        ((access.Login.TOKEN, TOKEN), "", None),  # admitted by the cookie: it may not say who it is
        ((access.Login.NONE, ""), "", None),
        ((access.Login.NONE, ""), "Bearer ", None),
    ],
)
def test_only_a_proxy_that_sends_the_token_says_who_the_viewer_is(
    login: tuple[access.Login, str], authorization: str, viewer: str | None
) -> None:
    scopes = list[dict[str, Any]]()

    async def app(scope: dict[str, Any], _receive: object, _send: object) -> None:
        scopes.append(scope)

    headers = {"host": "localhost", "cookie": f"{access.COOKIE}={access.cookie_of(TOKEN)}"}
    headers |= {"authorization": authorization, access.VIEWER: "anna@example.org"}
    for kind in ("http", "websocket"):
        scope: dict[str, Any] = {"type": kind, "path": "/", "method": "GET", "query_string": b""}
        scope["headers"] = [(name.encode(), value.encode()) for name, value in headers.items()]
        asyncio.run(access.AccessGuard(app, *login)(scope, AsyncMock(), AsyncMock()))
    for scope in scopes:
        assert scope.get("viewer") == viewer
        assert dict(scope["headers"]).get(access.VIEWER.encode(), b"").decode() == (viewer or "")
    assert len(scopes) == 2


@pytest.mark.parametrize("authorization", ["", "Bearer", "Bearer wrong", f"Basic {TOKEN}", TOKEN])
def test_a_proxy_with_another_token_is_refused(authorization: str) -> None:
    named = {"authorization": authorization, access.VIEWER: "anna@example.org"}
    assert not ask((access.Login.TOKEN, TOKEN), "/", host="house", **named)[0]
    assert not ask((access.Login.TOKEN, ""), "/", host="house", **named)[0]


def test_a_page_is_framed_by_no_other_site() -> None:
    _, sent = ask((access.Login.TOKEN, TOKEN), "/", host="house:8501")
    assert (b"x-frame-options", b"SAMEORIGIN") in sent[0]["headers"]
    assert (b"x-content-type-options", b"nosniff") in sent[0]["headers"]


@pytest.mark.parametrize("login", LOGINS)
def test_routes_of_streamlit_s_that_no_page_needs_are_closed(
    login: tuple[access.Login, str],
) -> None:
    cookie = f"{access.COOKIE}={access.cookie_of(TOKEN)}"
    for path in ("metrics", "agent/openapi.json"):
        for base in ("", "/house"):
            asked = ask(login, f"{base}/_stcore/{path}", host="localhost", cookie=cookie)
            assert not asked[0]
    assert ask(login, "/_stcore/health", host="localhost", cookie=cookie)[0]


NewPage = Callable[[], Any]
StartServer = Callable[..., str]


def links(page: Any) -> Any:
    """The links to the pages, which only who is logged in sees."""
    return page.locator(".st-key-nav a")


def test_only_the_link_with_the_token_opens_the_pages(
    start_server: StartServer, new_page: NewPage, tmp_path: Path
) -> None:
    variables = {"CUCUMBERVISION_TOKEN": TOKEN, "HOME": str(tmp_path)}
    address = start_server(tmp_path, "--login", "--store", str(tmp_path / "house.db"), **variables)
    page = new_page()
    for path in ("", "/capture", "/_stcore/health", "/?token=wrong"):
        assert page.goto(address + path).status == 403
    form = {"file": {"name": "a.png", "mimeType": "image/png", "buffer": b"x"}}
    upload = f"{address}/_stcore/upload_file/invented/1"
    assert page.request.put(upload, multipart=form).status == 403
    page.goto(f"{address}/settings?token={TOKEN}")
    links(page).first.wait_for()
    assert "token" not in page.url
    # The cookie admits this browser from now on, and no other.
    page.goto(address)
    links(page).first.wait_for()
    assert new_page().goto(address).status == 403


def test_who_comes_through_a_proxy_signs_the_changes(
    start_server: StartServer, new_page: NewPage, tmp_path: Path
) -> None:
    path = tmp_path / "house.db"
    with open_store(path) as store:
        store.save_round(WALK)
        options = MeasureOptions(instances="dataset", segmenter="none", methods=(MethodName.M1,))
        add_captures(store, WALK.key, [example_captures() / "simulated-row-b"], options)
    variables = {"CUCUMBERVISION_TOKEN": TOKEN, "HOME": str(tmp_path)}
    address = start_server(tmp_path, "--login", "--store", str(path), **variables)
    page = new_page()
    page.set_extra_http_headers(
        {"Authorization": f"Bearer {TOKEN}", "X-Forwarded-Email": "anna@example.org"}
    )
    page.goto(f"{address}/results?round={WALK.key}")
    page.locator(".fruit button").first.click()
    page.locator("[class*='st-key-accepted_'] button").click()
    with open_store(path, create=False) as store:
        while not store.log(WALK.key):
            page.wait_for_timeout(100)
        assert {action.by for action in store.log(WALK.key)} == {"anna@example.org"}
