from __future__ import annotations

import pytest

pytest.importorskip("streamlit")
pytest.importorskip("httpx2")

from starlette.testclient import TestClient
from tests.greenhouse.capture_page.test_routes import WALK

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
