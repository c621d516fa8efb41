from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("streamlit")
pytest.importorskip("httpx2")

from starlette.requests import Request
from starlette.testclient import TestClient
from tests.greenhouse.camera.test_page import WALK

from cucumbervision_greenhouse.answers import answer
from cucumbervision_greenhouse.store.repository import Store


def test_news_tell_of_a_change_in_the_round_once(asked: TestClient, store: Store) -> None:
    with asked.websocket_connect(f"/api/news?round={WALK}") as line:
        first = line.receive_json()
        assert first["work"] == {"words": "", "done": 0, "total": 0, "waiting": 0}
        line.send_text("next")
        again = line.receive_json()  # the same after a while: the line is not dead
        assert {**again, "now_s": 0} == {**first, "now_s": 0}
        assert again["now_s"] - first["now_s"] >= 2.0
        store.pick([store.detections(WALK)[0].key])
        line.send_text("next")
        while line.receive_json()["version"] == first["version"]:
            line.send_text("next")  # until the test's own limit


def test_times_are_in_the_zone_that_the_computer_has_now(
    asked: TestClient, in_zone: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    for zone, name in (("Asia/Tokyo", "JST"), ("Pacific/Honolulu", "HST")):
        in_zone("UTC")
        monkeypatch.setenv("TZ", zone)  # as the computer's own zone is changed
        if name == "JST":
            asked.get("/api/walk")
        else:
            with asked.websocket_connect(f"/api/news?round={WALK}") as line:
                line.receive_json()
        assert time.tzname[0] == name


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
