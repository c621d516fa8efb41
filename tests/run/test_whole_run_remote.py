"""Captures and results on stores of the network: S3 and HTTP servers on loopback."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.request import Request, urlopen

import pytest

from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CaptureError, CucumberVisionError
from cucumbervision.files import as_path, with_retries
from cucumbervision.methods.result import MethodName
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import BatchOptions, RunResult, measure_inputs

s3fs = pytest.importorskip("s3fs")
moto_server = pytest.importorskip("moto.server")

OPTIONS = MeasureOptions(instances="dataset", methods=(MethodName.M1,))
NAMES = ("simulated-bench", "simulated-row-b")


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A bucket of a real server, with two captures in it."""
    server = moto_server.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    # What an earlier server of this process held is still there.
    urlopen(Request(f"http://{host}:{port}/moto-api/reset", method="POST")).close()
    for name, value in {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "house",
        "AWS_SECRET_ACCESS_KEY": "cucumber",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    store = s3fs.S3FileSystem()
    store.mkdir("house")
    for name in NAMES:
        store.put(str(example_captures() / name), f"house/captures/{name}", recursive=True)
    yield "s3://house"
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


def cells(result: RunResult) -> list[dict[str, object]]:
    return [{k: v for k, v in row.items() if k != "source"} for row in result.rows]


def test_s3_in_and_out_give_the_rows_of_folders_and_go_on(bucket: str, tmp_path: Path) -> None:
    here = measure_inputs([example_captures() / n for n in NAMES], tmp_path / "out", OPTIONS)
    places = [f"{bucket}/captures"]
    batch = BatchOptions(parquet=True)
    far = measure_inputs(places, f"{bucket}/out", OPTIONS, batch=batch)
    assert (far.exit_code, cells(far)) == (0, cells(here))
    assert far.rows[0]["source"] == f"{bucket}/captures/{NAMES[0]}"
    out = as_path(f"{bucket}/out")
    table = (out / "measurements.csv").read_bytes()
    assert table.count(b"\r\n") == 1 + len(here.rows)
    report = json.loads((out / "measurements.json").read_text())
    assert [capture["name"] for capture in report["captures"]] == list(NAMES)
    assert (out / "overlays" / f"{NAMES[0]}.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "parquet" / "part-00000.parquet").exists()
    again = measure_inputs(places, f"{bucket}/out", OPTIONS)
    assert (again.before, (out / "measurements.csv").read_bytes()) == (2, table)


def test_a_bucket_that_is_not_there_is_said_at_once(bucket: str, tmp_path: Path) -> None:
    with pytest.raises(CucumberVisionError, match="s3://nowhere/out: cannot be written"):
        measure_inputs([example_captures()], "s3://nowhere/out", OPTIONS)
    result = measure_inputs([f"{bucket}/nothing"], tmp_path / "out", OPTIONS)
    assert [failure.error for failure in result.failures] == ["CaptureError"]
    assert result.failures[0].message.startswith(f"{bucket}/nothing: does not exist")


def test_a_store_that_is_gone_for_a_while_is_asked_again(
    bucket: str, caplog: pytest.LogCaptureFixture
) -> None:
    answers: Iterator[Exception | bytes] = iter(
        [ConnectionError("gone"), RuntimeError("gone"), b"back"]
    )

    def read() -> bytes:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    place = as_path(f"{bucket}/captures/a.png")
    assert with_retries(place, read, waits_s=(0, 0)) == b"back"
    said = f"{bucket}/captures/a.png: does not answer (ConnectionError); asked again in 0 s"
    assert caplog.messages[0] == said
    with pytest.raises(OSError, match=r"the store does not answer \(StopIteration"):
        with_retries(place, read, waits_s=(0,))


def test_captures_are_read_over_http(tmp_path: Path) -> None:
    handler = partial(QuietHandler, directory=str(example_captures()))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            url = f"http://127.0.0.1:{server.server_port}/{NAMES[1]}"
            result = measure_inputs([url], tmp_path, OPTIONS)
        finally:
            server.shutdown()
            thread.join()
    assert result.failures == []
    assert (result.captures, result.summary.fruit) == (1, 2)


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *arguments: object) -> None:
        """Say nothing."""


def test_a_recording_on_a_store_is_refused(bucket: str) -> None:
    from cucumbervision.capture.readers import open_source

    (as_path(bucket) / "walk.bag").write_bytes(b"#ROSBAG V2.0")
    with pytest.raises(CaptureError, match="copy it here"):
        open_source(f"{bucket}/walk.bag")


def test_an_unknown_protocol_is_refused() -> None:
    with pytest.raises(CucumberVisionError, match="nowhere://a: is not a supported location"):
        as_path("nowhere://a")
