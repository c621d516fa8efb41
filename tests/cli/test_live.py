"""Frames, keys and captures as lines, from a folder in place of a camera."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import jsonschema
import pytest
from typer.testing import CliRunner

from cucumbervision.capture.camera import DepthQuality, Recorded
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.cli.app import app
from cucumbervision.cli.live import clock, enter_keys, print_recording, print_stream
from cucumbervision.errors import CameraError
from cucumbervision.run.measurer import Failure, Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.stream.fruit_stream import FruitStream, StreamedFrame

Run = Callable[..., subprocess.CompletedProcess[str]]
UNREAD = Failure("a", "[b]", "CaptureError", "[b]: is damaged; copy it again")


@pytest.fixture(scope="module")
def frames() -> list[StreamedFrame]:
    """Three frames of one bench."""
    (ref,) = open_source(example_captures() / "simulated-bench")
    fruit = FruitStream(Measurer(MeasureOptions(instances="dataset")))
    return [fruit.take(ref.load()) for _ in range(3)]


def test_each_frame_is_a_line_of_json(
    frames: list[StreamedFrame], capsys: pytest.CaptureFixture[str]
) -> None:
    assert print_stream(iter([frames[0], UNREAD, frames[1]])) == 1
    told = capsys.readouterr()
    lines = [json.loads(line) for line in told.out.splitlines()]
    assert [line["capture"] for line in lines] == ["simulated-bench"] * 2
    assert [len(line["fruit"]) for line in lines] == [3, 3]
    assert "failed [b]: is damaged; copy it again" in told.err
    assert "2 frames, 0 dropped" in told.err


def test_a_stream_ends_after_as_many_frames_as_were_asked_for(
    frames: list[StreamedFrame], capsys: pytest.CaptureFixture[str]
) -> None:
    arrivals = iter(frames)
    assert print_stream(arrivals, 2, quiet=True) == 0
    told = capsys.readouterr()
    assert (len(told.out.splitlines()), told.err) == (2, "")
    assert list(arrivals) == frames[2:]


def test_a_camera_that_is_lost_ends_the_stream_in_plain_words(
    frames: list[StreamedFrame], capsys: pytest.CaptureFixture[str]
) -> None:
    def lost() -> Iterator[StreamedFrame]:
        yield from frames[:1]
        raise CameraError("was unplugged", source="0042", remedy="plug it in")

    assert print_stream(lost()) == 1
    told = capsys.readouterr()
    assert len(told.out.splitlines()) == 1
    assert "ended 0042: was unplugged; plug it in" in told.err
    assert print_stream(iter([UNREAD])) == 2


def test_a_reader_that_goes_away_ends_the_stream_quietly() -> None:
    code = "from cucumbervision.cli.app import main; main()"
    bench = example_captures() / "simulated-bench"
    words = ["stream", str(bench), "--instances", "dataset", "--segmenter", "none", "--quiet"]
    with subprocess.Popen(
        [sys.executable, "-c", code, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        assert process.stderr.read() == b""
    assert process.returncode in {0, 2}


def test_every_line_of_input_is_a_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("\n\nlast"))
    assert list(enter_keys()) == [None] * 3


def test_the_clock_ticks_at_once_and_catches_nothing_up(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, slept = [100.0], []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now_s[0] += seconds

    monkeypatch.setattr("time.monotonic", lambda: now_s[0])
    monkeypatch.setattr("time.sleep", sleep)
    ticks = clock(2.0)
    times_s = []
    for busy_s in (0.5, 5.0, 0.0, 0.0):
        next(ticks)
        times_s.append(now_s[0])
        now_s[0] += busy_s
    # The second capture took 5 s: the third is taken at once, the fourth 2 s after it.
    assert times_s == [100.0, 102.0, 107.0, 107.0 + 2.0]


def test_each_capture_is_a_line_with_its_depth_and_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (ref,) = open_source(example_captures() / "simulated-bench")
    folder, lost = tmp_path / "[b] :ok:", CameraError("was unplugged", source="0042", remedy="x")
    quality = DepthQuality(0.97, 0.452, "good", "good")
    recorded = Recorded(ref.load(), folder / "capture.json", quality)
    assert print_recording(iter([recorded, lost, recorded])) == 1
    told = capsys.readouterr()
    assert told.out == f"{folder}  depth 97 %, 45 cm  good\n" * 2
    assert told.err == "failed 0042: was unplugged; x\n2 captures written, 1 failed\n"
    assert print_recording(iter([recorded]), quiet=True) == 0
    assert capsys.readouterr() == ("", "")
    assert print_recording(iter([lost])) == 2


def test_without_a_camera_the_list_says_what_to_do(run: Run) -> None:
    pytest.importorskip("pyrealsense2", exc_type=ImportError)
    done = run("cameras")
    if done.returncode == 0:
        pytest.skip("a camera is connected")
    assert (done.returncode, done.stdout) == (
        2,
        "No RealSense camera is connected; plug a D4xx into a USB 3 port\n",
    )


@pytest.mark.parametrize(
    ("kind", "holds"), [("stream", "fruit"), ("measure", "captures"), ("detect", "pictures")]
)
def test_a_schema_is_one_and_names_its_version(kind: str, holds: str) -> None:
    schema = json.loads(CliRunner().invoke(app, ["schema", kind]).output)
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["properties"]["version"]["const"] == 1
    assert holds in schema["required"]
    described = [one.get("description", "") for one in schema["$defs"].values()]
    assert not [text for text in described if "\n" in text]
