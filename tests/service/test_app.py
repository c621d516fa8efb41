"""The service in its own process's hands: what it measures, refuses and counts."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator, MutableMapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import cv2
import jsonschema
import numpy as np
import pytest
from starlette.testclient import TestClient

pytest.importorskip("fastapi")

from cucumbervision.capture.frames import Capture
from cucumbervision.errors import UploadError
from cucumbervision.run.fields import FIELDS
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.service.app import (
    MeasureReply,
    ServiceSettings,
    Work,
    create_app,
    request_limits,
)
from cucumbervision.service.client import packed

TOKEN = "0123456789abcdef"
ADMITTED = {"Authorization": f"Bearer {TOKEN}"}
HERE = "http://127.0.0.1:8600"


@pytest.fixture
def client(measurer: Measurer) -> Iterator[TestClient]:
    with TestClient(create_app(measurer, ServiceSettings(TOKEN)), headers=ADMITTED) as client:
        yield client


def test_a_capture_comes_back_as_the_rows_of_the_tables(
    client: TestClient, measurer: Measurer, bench: Capture
) -> None:
    reply = client.post("/measure", files=[("files", packed(bench))])
    assert reply.status_code == 200, reply.text
    told = reply.json()
    (capture,) = told["captures"]
    assert (capture["name"], capture["simulated"]) == ("simulated-bench", True)
    expected = measurer.measure(bench).rows()
    assert len(capture["fruit"]) == len(expected) == 3
    for row, own in zip(capture["fruit"], expected, strict=True):
        pose = row.pop("pose")
        assert list(row) == [one.name for one in FIELDS]
        assert pose["blossom_m"][0] == pytest.approx(row["blossom_x_m"], abs=1e-4)
        # Where it was read from is the sender's name here, and a path there.
        assert {k: v for k, v in row.items() if k != "source"} == {
            k: v for k, v in own.items() if k != "source"
        }
    assert told["config_sha256"] == measurer.options.sha256
    jsonschema.validate(reply.json(), MeasureReply.model_json_schema(mode="serialization"))


def test_what_cannot_be_read_costs_the_others_nothing(client: TestClient, bench: Capture) -> None:
    files = [
        ("files", ("../../x.png", b"MZ no picture")),
        ("files", packed(bench)),
        ("files", ("half.zip", packed(bench)[1][:5000])),
    ]
    told = client.post("/measure", files=files).json()
    assert [capture["name"] for capture in told["captures"]] == ["simulated-bench"]
    assert [(failure["name"], failure["error"]) for failure in told["failures"]] == [
        ("half.zip", "UploadError"),
        ("x.png", "CaptureError"),
    ]
    assert not any("/tmp" in failure["message"] for failure in told["failures"])


def test_detect_gives_boxes_as_coco_has_them(one_box_detector: Path) -> None:
    measurer = Measurer(MeasureOptions(instances=str(one_box_detector), segmenter="none"))
    picture = cv2.imencode(".png", np.full((64, 64, 3), 90, np.uint8))[1].tobytes()
    files = [("files", ("a.png", picture)), ("files", ("b.txt", b"text"))]
    with TestClient(create_app(measurer), HERE) as client:
        told = client.post("/detect", files=files).json()
        (seen,) = told["pictures"]
        # The network's box is 8, 8 to 40, 30 pixels from the picture's corner.
        (fruit,) = seen["fruit"]
        assert (fruit["bbox"], fruit["score"], fruit["class"]) == ([8, 8, 32, 22], 0.75, "cucumber")
        assert [(failure["name"], failure["error"]) for failure in told["failures"]] == [
            ("b.txt", "CaptureError")
        ]
        assert client.get("/health").json()["models"] == [one_box_detector.name]


def form(*parts: bytes) -> dict[str, Any]:
    """A request whose form has these parts, and no closing boundary but the caller's own."""
    head = b'--x\r\nContent-Disposition: form-data; name="files"; filename="a.png"\r\n\r\n'
    kind = {"Content-Type": "multipart/form-data; boundary=x"}
    return {"content": b"".join(head + part for part in parts), "headers": kind}


def test_a_form_whose_last_file_is_cut_off_is_refused(client: TestClient) -> None:
    reply = client.post("/measure", **form(b"one\r\n", b"tw"))
    assert (reply.status_code, reply.json()["message"]) == (
        400,
        "the form is cut off; send it again",
    )
    assert client.post("/measure", **form(b"one\r\n", b"two\r\n--x--\r\n")).status_code == 200


@pytest.mark.parametrize("token", ["", "Bearer", "Bearer 0123456789abcdeF", f"Basic {TOKEN}"])
def test_nobody_else_gets_in(measurer: Measurer, token: str) -> None:
    with TestClient(create_app(measurer, ServiceSettings(TOKEN))) as client:
        given = {"Authorization": token} if token else {}
        for path in ("/measure", "/detect"):
            reply = client.post(path, headers=given, content=b"x")
            assert reply.status_code == 401
            assert reply.headers["www-authenticate"] == "Bearer"
        assert client.get("/metrics", headers=given).status_code == 401
        assert client.get("/openapi.json", headers=given).status_code == 401
        assert client.get("/health").json()["status"] == "ok"


def test_no_body_is_read_before_the_token(measurer: Measurer) -> None:
    app, sent = create_app(measurer, ServiceSettings(TOKEN)), []
    scope = {
        **{"type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "scheme": "http"},
        **{"method": "POST", "path": "/measure", "raw_path": b"/measure", "root_path": ""},
        **{"query_string": b"", "client": None, "server": None},
        "headers": [(b"content-type", b"multipart/form-data; boundary=x")],
    }

    async def receive() -> dict[str, object]:
        raise AssertionError("the body was asked for")

    async def send(message: MutableMapping[str, object]) -> None:
        sent.append(message)

    anyio.run(app, scope, receive, send)
    assert sent[0]["status"] == 401


@pytest.mark.parametrize("told", [True, False])
def test_a_body_that_is_too_large_is_refused(measurer: Measurer, told: bool) -> None:
    settings = ServiceSettings(limits=request_limits(1))
    body = b"--x\r\n" + b"a" * 3_000_000
    content: bytes | io.BytesIO = body if told else io.BytesIO(body)
    with TestClient(create_app(measurer, settings), HERE) as client:
        kind = {"Content-Type": "multipart/form-data; boundary=x"}
        reply = client.post("/measure", headers=kind, content=content)
    assert reply.status_code == 413
    assert reply.json() == {
        "error": "HTTPError",
        "message": "the body is larger than the 2 MB that are taken",
    }


def test_refusals_say_why_in_one_form(client: TestClient) -> None:
    no_border = {"Content-Type": "multipart/form-data"}
    for reply, status in (
        (client.post("/measure"), 422),
        (client.get("/measure"), 405),
        (client.get("/nowhere"), 404),
        (client.post("/measure", content=b"x", headers=no_border), 400),
    ):
        assert reply.status_code == status
        assert set(reply.json()) == {"error", "message"}


def test_what_was_done_is_counted(client: TestClient, bench: Capture) -> None:
    client.post("/measure", files=[("files", packed(bench))])
    client.get("/a-path-of-a-stranger")
    lines = client.get("/metrics").text.splitlines()
    assert 'cucumbervision_requests_total{path="/measure",status="200"} 1.0' in lines
    assert 'cucumbervision_requests_total{path="other",status="404"} 1.0' in lines
    assert 'cucumbervision_found_total{what="fruit"} 3.0' in lines
    assert 'cucumbervision_request_seconds_count{path="/measure"} 1.0' in lines


def test_the_description_names_every_column(client: TestClient) -> None:
    told = client.get("/openapi.json").json()
    columns = told["components"]["schemas"]["FruitRow"]["properties"]
    assert {name: one["description"] for name, one in columns.items() if name != "pose"} == {
        one.name: one.says for one in FIELDS
    }
    assert json.dumps(told).count("http") < 5  # no page that loads from elsewhere


def test_no_trace_goes_where_the_environment_says(
    measurer: Measurer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FASTAPI_OTEL_AUTO_CONFIGURE", "true")
    # FastAPI would refuse to start with this, if it looked at it.
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "no address")
    with TestClient(create_app(measurer, ServiceSettings(TOKEN)), headers=ADMITTED) as client:
        assert client.get("/health").status_code == 200


def test_requests_take_turns(measurer: Measurer, bench: Capture) -> None:
    work, inside, most = Work(measurer, ServiceSettings(waiting=8)), [0], [0]

    def one() -> None:
        with work.turn():
            inside[0] += 1
            most[0] = max(most[0], inside[0])
            inside[0] -= 1

    threads = [threading.Thread(target=one) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert most == [1]


def test_what_was_sent_is_answered_under_its_own_name(measurer: Measurer, bench: Capture) -> None:
    name, data = packed(bench)
    sent = {name: data, "../x\0.png": b"MZ", "n.txt": b"our walk"}
    files = [(title, io.BytesIO(content)) for title, content in sent.items()]
    reply = Work(measurer, ServiceSettings()).measure(files)
    (capture,) = reply.captures
    assert (capture.name, capture.simulated, len(capture.fruit)) == ("simulated-bench", True, 3)
    assert (capture.width, capture.height) == bench.intrinsics.size
    assert [fault.name for fault in reply.failures] == ["x.png"]
    assert reply.ignored == ["n.txt"]
    assert "/tmp" not in reply.model_dump_json()


def test_more_pictures_than_are_taken_at_once_are_refused(measurer: Measurer) -> None:
    settings = ServiceSettings(limits=replace(ServiceSettings().limits, files=2))
    files = [(f"{k}.png", io.BytesIO(b"x")) for k in range(3)]
    with pytest.raises(UploadError, match="3 files were sent, at most 2 are taken at once"):
        Work(measurer, settings).detect(files)
