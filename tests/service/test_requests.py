from __future__ import annotations

import asyncio
import logging
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import pytest
import uvicorn
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.testclient import TestClient

pytest.importorskip("starlette")
pytest.importorskip("fastapi")

from cucumbervision.errors import AccessError, CucumberVisionError
from cucumbervision.run.finders import Finder
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.service.app import ServiceSettings, Work, create_app
from cucumbervision.service.requests import (
    HeadLimit,
    RequestError,
    _OnceAMinute,
    bounded,
    check_source,
    listen,
    parse_place,
)

LINK = {"sec-fetch-mode": "navigate", "sec-fetch-dest": "document"}


@pytest.mark.parametrize(
    "value", ["", "a b", "a:0", "a:70000", "a:port", "[::1", "::1", "a" * 254, "a/b", "a@b"]
)
def test_a_malformed_host_is_refused(value: str) -> None:
    with pytest.raises(RequestError, match="the header Host is malformed"):
        parse_place(value)


def test_a_place_has_a_name_in_lower_case_and_a_port() -> None:
    assert parse_place("HOUSE:443") == ("", "house", 443)
    assert parse_place("http://[::1]:80", "Origin") == ("http", "::1", 80)
    with pytest.raises(RequestError, match="the header Origin is malformed"):
        parse_place("house.example", "Origin")


@pytest.mark.parametrize(
    "headers",
    [
        {"host": "house:8501"},
        {"host": "house:8501", "origin": "http://house:8501"},
        {"host": "house", "origin": "https://house:443"},
        # a link on another page that is followed
        {"host": "house", "sec-fetch-site": "cross-site", **LINK},
    ],
)
def test_our_own_pages_and_links_are_admitted(headers: dict[str, str]) -> None:
    check_source(Headers(headers))


@pytest.mark.parametrize(
    ("headers", "method", "local", "fault"),
    [
        ({"host": "house:8501", "origin": "http://house:8600"}, "GET", False, "may not send"),
        ({"host": "house", "origin": "http://other"}, "POST", False, "may not send"),
        ({"host": "house", "origin": "null"}, "POST", False, "may not send"),
        ({"origin": "http://house"}, "GET", False, "may not send"),
        ({"host": "house", "sec-fetch-site": "cross-site"}, "GET", False, "another place"),
        ({"host": "house", "sec-fetch-site": "same-site", **LINK}, "POST", False, "another place"),
        ({"host": "house.example"}, "GET", True, "not this machine"),
        ({}, "GET", True, "not this machine"),
    ],
)
def test_pages_of_other_places_are_refused(
    headers: dict[str, str], method: str, local: bool, fault: str
) -> None:
    with pytest.raises(AccessError, match=fault):
        check_source(Headers(headers), method=method, local=local)


def test_a_header_that_comes_twice_is_refused() -> None:
    twice = Headers(raw=[(b"host", b"house"), (b"host", b"other")])
    with pytest.raises(RequestError, match="Host is there twice"):
        check_source(twice)


def received(parts: Sequence[bytes], most_bytes: int, declared: str = "") -> list[Any]:
    """Return what a limited body yields, part by part; the client falls silent after the last."""
    waiting = [
        {"type": "http.request", "body": part, "more_body": k + 1 < len(parts)}
        for k, part in enumerate(parts)
    ]

    async def receive() -> Any:
        if waiting:
            return waiting.pop(0)
        await asyncio.sleep(60)
        return {}

    async def read() -> list[Any]:
        headers = Headers({"content-length": declared} if declared else {})
        limited = bounded(receive, headers, most_bytes, body_s=5.0, silence_s=0.05)
        return [await limited() for _ in range(max(len(parts), 1))]

    return asyncio.run(read())


def test_a_body_is_read_up_to_its_limit_and_no_further() -> None:
    assert [part["body"] for part in received([b"abc", b"de"], 5)] == [b"abc", b"de"]
    with pytest.raises(HTTPException, match="larger") as refused:
        received([b"abc", b"def"], 5)
    assert refused.value.status_code == 413
    with pytest.raises(HTTPException) as refused:
        received([b"abc"], 5, declared="6")
    assert refused.value.status_code == 413
    with pytest.raises(HTTPException) as refused:
        received([], 5)
    assert refused.value.status_code == 408


MEASURER = Measurer(MeasureOptions(instances="dataset"))
HEAD = (
    b"POST /measure HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: %d\r\n"
    b"Content-Type: multipart/form-data; boundary=x\r\n\r\n"
)
HEALTH = b"GET /health HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost:9000"}, 200),
        ({"Host": "[::1]:9000"}, 200),
        ({"Host": "rebound.example"}, 403),
        ({"Host": ""}, 403),
        ({"Origin": "http://127.0.0.1:8600"}, 200),
        ({"Origin": "http://stranger.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "no-cors"}, 403),
        ({"Host": "[::1"}, 400),
        ({"Host": "127.0.0.1:x"}, 400),
        ({"Origin": "http://[127.0.0.1:8600"}, 400),
        ({"Origin": "127.0.0.1"}, 400),
    ],
)
def test_without_a_token_pages_of_other_sites_are_refused(
    headers: dict[str, str], status: int
) -> None:
    with TestClient(create_app(MEASURER), "http://127.0.0.1:8600") as client:
        reply = client.get("/metrics", headers=headers)
        assert reply.status_code == status
        named = {400: "RequestError", 403: "AccessError"}
        assert status == 200 or reply.json()["error"] == named[status]


def test_with_a_token_any_host_is_served_but_no_page_of_another_site() -> None:
    token = "0123456789abcdef"
    admitted = {"Authorization": f"Bearer {token}"}
    with TestClient(create_app(MEASURER, ServiceSettings(token)), headers=admitted) as client:
        assert client.get("/metrics", headers={"Host": "robot.house"}).status_code == 200
        stranger = {"Origin": "http://stranger.example"}
        assert client.get("/metrics", headers=stranger).status_code == 403


class Quick(HeadLimit):
    head_s = 0.5


@contextmanager
def listening(measurer: Measurer, settings: ServiceSettings | None = None) -> Iterator[int]:
    """Serve on a port; what does not come on is waited for half a second at most."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        number: int = free.getsockname()[1]
    app = create_app(measurer, settings or ServiceSettings(silence_s=0.5))
    server = uvicorn.Server(uvicorn.Config(app, port=number, http=Quick, log_level="critical"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield number
    finally:
        server.should_exit = True
        thread.join()


def answer(port: int, *sent: bytes) -> bytes:
    """Send and wait until the server closes the connection."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        for part in sent:
            connection.sendall(part)
        return b"".join(iter(lambda: connection.recv(4096), b""))


def test_who_sends_no_whole_head_or_body_is_not_waited_for() -> None:
    with listening(MEASURER) as port:
        assert answer(port) == b""
        assert answer(port, HEAD % 5000, b"--x\r\n").startswith(b"HTTP/1.1 408 ")
        assert answer(port, HEAD[:40]) == b""
        # The head of a second request on the same connection counts, too.
        kept = HEALTH.replace(b"Connection: close\r\n", b"")
        assert answer(port, kept, kept[:30]).count(b"HTTP/1.1 200") == 1


def test_half_heads_and_bare_connections_keep_nobody_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Quick, "most_connections", 20)
    monkeypatch.setattr(Quick, "head_s", 60.0)
    with listening(MEASURER) as port:
        opened = [socket.create_connection(("127.0.0.1", port)) for _ in range(60)]
        for connection in opened[::2]:
            with suppress(OSError):
                connection.sendall(HEALTH[:30])
        assert answer(port, HEALTH).startswith(b"HTTP/1.1 200 ")
        for connection in opened:
            connection.close()


def test_a_flood_of_requests_writes_a_line_a_minute() -> None:
    once = _OnceAMinute()
    record = logging.LogRecord("a", logging.WARNING, "", 0, "damaged", (), None)
    assert [bool(once.filter(record)) for _ in range(3)] == [True, False, False]


def test_a_taken_port_is_named_and_no_address_is_announced() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port, announced = taken.getsockname()[1], list[int]()
        with pytest.raises(CucumberVisionError, match=f"port {port} cannot be used .* --port"):
            listen(create_app(MEASURER), "127.0.0.1", port, ready=lambda: announced.append(port))
    assert announced == []


def test_a_malformed_chunk_is_refused_without_an_error_of_the_program(
    caplog: pytest.LogCaptureFixture,
) -> None:
    head = HEAD.replace(b"Content-Length: %d", b"Transfer-Encoding: chunked")
    with listening(MEASURER) as port:
        assert answer(port, head, b"zz\r\n").startswith(b"HTTP/1.1 400 ")
        both = head.replace(b"Host", b"Content-Length: 5\r\nHost")
        told = answer(port, both, b"0\r\n\r\n")
        assert told.startswith(b"HTTP/1.1 400 ")
        assert b"contradict" in told
    assert not caplog.records


def test_who_comes_when_too_many_wait_is_refused_before_its_body_is_read() -> None:
    settings = ServiceSettings(silence_s=60.0, waiting=1)
    with listening(MEASURER, settings) as port:
        waiting = [socket.create_connection(("127.0.0.1", port)) for _ in range(2)]
        for connection in waiting:  # their bodies are on their way
            connection.sendall(HEAD % 5000 + b"--x")
        told = answer(port, HEAD % 50_000_000)  # none of which is sent
        assert told.startswith(b"HTTP/1.1 503 ")
        assert b"retry-after: 1" in told.lower()
        assert b"BusyError" in told
        for connection in waiting:
            connection.close()
        assert answer(port, HEALTH).startswith(b"HTTP/1.1 200 ")


def test_a_client_that_leaves_the_queue_is_not_served(monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, queued, turn = threading.Event(), threading.Semaphore(0), Work.turn

    def noted_turn(*given: Any) -> Any:
        queued.release()
        return turn(*given)

    class Slow(Measurer):
        def load(self) -> Finder:
            go_on.wait(60)
            return super().load()

    monkeypatch.setattr(Work, "turn", noted_turn)
    part = b'--x\r\nContent-Disposition: form-data; name="files"; filename="a"\r\n\r\na\r\n--x--'
    with listening(Slow(MEASURER.options)) as port:
        first, second = (socket.create_connection(("127.0.0.1", port)) for _ in range(2))
        for connection in (first, second):
            connection.sendall(HEAD % len(part) + part)
            assert queued.acquire(timeout=60)
        second.close()
        go_on.set()
        with first:
            assert first.recv(4096).startswith(b"HTTP/1.1 200 ")
        left = b'cucumbervision_requests_total{path="/measure",status="499"} 1.0'
        ask = b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
        for _ in range(600):
            if left in answer(port, ask):
                return
            time.sleep(0.05)
    raise AssertionError("it was served, or never counted")
