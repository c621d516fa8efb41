"""The client against the command itself, on loopback."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("fastapi")

from cucumbervision.access import TOKEN_VARIABLE
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.cli.app import app
from cucumbervision.errors import AccessError, CaptureError
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.service.client import Client, ServiceError

TOKEN = "a-token-of-the-tests"


@pytest.fixture(scope="module")
def service() -> Iterator[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    code = "from cucumbervision.cli.app import main; main()"
    command = [sys.executable, "-c", code, "serve", "--port", str(port), "--segmenter", "none"]
    environment = {**os.environ, "CUCUMBERVISION_TOKEN": TOKEN}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        url = f"http://127.0.0.1:{port}"
        for _ in range(600):
            try:
                Client(url).health()
                break
            except ServiceError:
                assert process.poll() is None, process.stderr and process.stderr.read()
                time.sleep(0.2)
        yield url
        process.terminate()


def test_captures_go_and_rows_come(service: str) -> None:
    capture = next(iter(open_source(example_captures() / "simulated-bench"))).load()
    client = Client(service, TOKEN)
    told = client.measure(capture)
    (measured,) = told["captures"]
    own = Measurer(MeasureOptions(segmenter="none")).measure(capture).rows()
    lengths = [row["length_cm"] for row in own]
    assert [row["length_cm"] for row in measured["fruit"]] == lengths
    assert told["failures"] == []


def test_a_folder_goes_as_the_captures_that_it_holds(service: str, tmp_path: Path) -> None:
    client = Client(service, TOKEN)
    folder = example_captures() / "simulated-bench"
    (of_folder,) = client.measure(folder)["captures"]
    (of_capture,) = client.measure(next(iter(open_source(folder))).load())["captures"]
    assert of_folder["fruit"] == of_capture["fruit"] != []
    with pytest.raises(CaptureError, match=r"none\.zip: cannot be read"):
        client.measure(tmp_path / "none.zip")


def test_a_recording_is_played_here_and_goes_as_its_captures(service: str, recording: Path) -> None:
    told = Client(service, TOKEN).measure(recording)
    assert told["failures"] == []
    names = [f"walk_{number:06d}" for number in _first_frames(recording)]
    assert [capture["name"] for capture in told["captures"]] == names


def _first_frames(recording: Path) -> list[int]:
    return [ref.frame for ref in open_source(recording)]


def test_where_other_machines_reach_it_nothing_is_said_to_listen_without_a_token() -> None:
    said = CliRunner().invoke(app, ["serve", "--address", "0.0.0.0"], env={TOKEN_VARIABLE: ""})
    assert isinstance(said.exception, AccessError)
    assert "http" not in said.output


def test_pictures_that_are_none_are_named(service: str, tmp_path: Path) -> None:
    broken = tmp_path / 'a "b".jpg'
    broken.write_bytes(b"no picture")
    told = Client(service, TOKEN).detect(broken)
    assert told["pictures"] == []
    assert [failure["error"] for failure in told["failures"]] == ["CaptureError"]


def test_a_wrong_token_is_said(service: str) -> None:
    health = Client(service).health()
    # The networks are there before the first request.
    assert health["status"] == "ok"
    assert health["models"] == ["cucumber-seg", "cucumber-fruit", "cucumber-look"]
    picture = example_captures() / "simulated-bench" / "color_000000.jpg"
    with pytest.raises(ServiceError, match="the token is missing or wrong") as refused:
        Client(service, "another-token-0123").detect(picture)
    assert refused.value.status == 401


def test_a_refusal_in_the_midst_of_what_is_sent_is_heard(tmp_path: Path) -> None:
    """A service that refuses by the head of a request does not read the rest before it hangs up."""
    large = tmp_path / "large.zip"
    large.write_bytes(bytes(20_000_000))
    body = b'{"message": "the token is missing or wrong"}'
    answer = b"HTTP/1.1 401 Unauthorized\r\nContent-Length: %d\r\n\r\n%s" % (len(body), body)

    def refuse(listening: socket.socket) -> None:
        connection, _ = listening.accept()
        with connection:
            read = b""
            while b"\r\n\r\n" not in read:
                read += connection.recv(256)
            connection.sendall(answer)

    with socket.create_server(("127.0.0.1", 0)) as listening, ThreadPoolExecutor(1) as executor:
        refused_at = executor.submit(refuse, listening)
        url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        with pytest.raises(ServiceError, match="the token is missing or wrong") as refused:
            Client(url, "wrong").measure(large)
        refused_at.result()
    assert refused.value.status == 401


def test_a_service_that_is_not_there_is_said() -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{closed.getsockname()[1]}"
        with pytest.raises(ServiceError, match="does not answer") as refused:
            Client(url, timeout_s=5).health()
    assert refused.value.status == 0
    with pytest.raises(ServiceError, match="not an address"):
        Client("file:///etc/passwd")
