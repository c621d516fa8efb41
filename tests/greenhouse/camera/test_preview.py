from __future__ import annotations

import json
import struct
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("streamlit")
pytest.importorskip("httpx2")

from starlette.testclient import TestClient
from tests.greenhouse.camera.test_page import press, sent, wait_for_jobs

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.recorder import depth_quality
from cucumbervision_greenhouse.camera.cameras import Preview
from cucumbervision_greenhouse.camera.preview import Shown


def test_a_preview_is_sent_when_it_changes_and_not_before_it_was_shown(
    asked: TestClient,
) -> None:
    with asked.websocket_connect("/api/preview?source=replay") as line:
        while (header := read(line.receive_bytes())[0])["state"] != "replay":
            line.send_text("next")
        assert header["simulated"]
        assert header["quality"]["seen"] == "100 %"
        line.send_text("next")
        press(asked, sent("a", time.time()))
        name = header["name"]
        while header["name"] == name:
            header, color, depth = read(line.receive_bytes())
            line.send_text("next")
        assert color[:2] == depth[:2] == b"\xff\xd8"
    wait_for_jobs()


def read(message: bytes) -> tuple[dict[str, Any], bytes, bytes]:
    """A message of the preview: header, colour, depth."""
    (length,) = struct.unpack("<I", message[:4])
    header = json.loads(message[4 : 4 + length])
    at = 4 + length + header.get("color_bytes", 0)
    return header, message[4 + length : at], message[at:]


def test_a_picture_that_shows_nothing_new_is_not_sent() -> None:
    rng, camera = np.random.default_rng(3), Intrinsics(320, 180, 230.0, 230.0, 160.0, 90.0)
    color = rng.integers(0, 256, (180, 320, 3)).astype(np.uint8)

    def preview(picture: Any, number: int) -> Preview:
        depth_m = np.full((180, 320), 0.5, np.float32)
        capture = Capture(picture, depth_m, camera, "a")
        return Preview("live", capture, depth_quality(capture), number)

    shown = Shown()
    assert shown.changes(preview(color, 1))
    assert not shown.changes(preview(color, 2))
    noise = rng.integers(-2, 3, color.shape)
    assert not shown.changes(preview((color + noise).clip(0, 255).astype(np.uint8), 3))
    moved = preview(np.roll(color, 40, axis=1), 4)
    assert shown.changes(moved)
    assert not shown.changes(replace(moved, number=5))
    assert shown.changes(Preview("absent", message="no camera"))
    assert not shown.changes(Preview("absent", message="no camera"))
