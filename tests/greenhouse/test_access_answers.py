from __future__ import annotations

import asyncio
from typing import Any

import pytest

pytest.importorskip("streamlit")
pytest.importorskip("httpx2")

from starlette.requests import Request
from starlette.testclient import TestClient
from tests.greenhouse.camera.test_page import WALK

from cucumbervision_greenhouse.access import answer
from cucumbervision_greenhouse.store.repository import Store


def test_news_tell_of_a_change_in_the_round(asked: TestClient, store: Store) -> None:
    first = asked.get(f"/api/news?round={WALK}").json()
    assert first["work"] == {"words": "", "done": 0, "total": 0, "first": "", "waiting": 0}
    assert asked.get(f"/api/news?round={WALK}").json()["version"] == first["version"]
    store.pick([store.detections(WALK)[0].key])
    assert asked.get(f"/api/news?round={WALK}").json()["version"] != first["version"]


def test_a_request_that_is_cut_off_is_no_fault_of_the_server() -> None:
    parts = [
        {"type": "http.request", "body": b'{"presses":', "more_body": True},
        {"type": "http.disconnect"},
    ]
    worked: list[Any] = []

    async def receive() -> Any:
        return parts.pop(0)

    route = answer(lambda *given: worked.append(given))
    scope = {"type": "http", "method": "POST", "headers": []}
    response: Any = asyncio.run(route(Request(scope, receive)))  # type: ignore[arg-type]
    assert (response.status_code, worked) == (400, [])
