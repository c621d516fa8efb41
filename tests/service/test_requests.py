from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import pytest

pytest.importorskip("starlette")

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException

from cucumbervision.errors import AccessError
from cucumbervision.service.requests import RequestError, bounded, check_source, parse_place


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
        {
            "host": "house",
            "sec-fetch-site": "cross-site",
            "sec-fetch-mode": "navigate",
            "sec-fetch-dest": "document",
        },
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
        (
            {
                "host": "house",
                "sec-fetch-site": "same-site",
                "sec-fetch-mode": "navigate",
                "sec-fetch-dest": "document",
            },
            "POST",
            False,
            "another place",
        ),
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
