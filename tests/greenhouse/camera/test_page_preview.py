from __future__ import annotations

import json
import struct
import time
from typing import Any

import pytest

pytest.importorskip("streamlit")
pytest.importorskip("httpx2")

from starlette.testclient import TestClient
from tests.greenhouse.camera.test_page import press, sent, wait_for_jobs


def test_a_picture_is_sent_once_and_the_next_after_a_press(asked: TestClient) -> None:
    def ask(shown: int | str = "") -> Any:
        return asked.get("/api/preview", params={"source": "replay", "shown": shown})

    while (header := read(ask().content)[0])["state"] != "replay":
        time.sleep(0.05)
    assert header["simulated"]
    assert header["quality"]["seen"] == "100 %"
    assert ask(header["number"]).status_code == 204
    press(asked, sent("a", time.time()))
    while (answer := ask(header["number"])).status_code == 204:
        time.sleep(0.05)
    after, color, depth = read(answer.content)
    assert after["name"] != header["name"]
    assert color[:2] == depth[:2] == b"\xff\xd8"
    wait_for_jobs()


def read(message: bytes) -> tuple[dict[str, Any], bytes, bytes]:
    """A message of the preview: header, colour, depth."""
    (length,) = struct.unpack("<I", message[:4])
    header = json.loads(message[4 : 4 + length])
    at = 4 + length + header.get("color_bytes", 0)
    return header, message[4 + length : at], message[at:]
