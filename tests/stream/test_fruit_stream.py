"""Streams of real captures through the one measurer, and where their frames come from."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from cucumbervision.capture.camera import FolderCamera
from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CameraError, CaptureError
from cucumbervision.methods.result import Choice
from cucumbervision.run.fields import FIELDS
from cucumbervision.run.finders import Detections
from cucumbervision.run.measurer import Failure, Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.stream.fruit_stream import (
    FRAME_FIELDS,
    TRACK_FIELDS,
    FruitStream,
    StreamedFrame,
    ahead,
    line_model,
    newest_first,
    open_stream,
    paced,
    stream_camera,
)


@pytest.fixture(scope="module")
def walk() -> list[Capture]:
    """A bundled capture of three fruit that moves 12 px a frame, 15 frames a second."""
    one = next(iter(open_source(example_captures() / "simulated-row-a"))).load()
    return [
        replace(
            one,
            color=np.roll(one.color, -12 * k, 1),
            depth_m=np.roll(one.depth_m, -12 * k, 1),
            masks=tuple(np.roll(mask, -12 * k, 1) for mask in one.masks),
            name=f"walk_{k}",
            frame=k,
            timestamp_s=1e9 + k / 15,
        )
        for k in range(4)
    ]


@pytest.fixture
def folder(walk: list[Capture], tmp_path: Path) -> Path:
    for capture in walk:
        write_native(capture, tmp_path / "walk" / capture.name)
    return tmp_path / "walk"


def by_masks(fits: int | None = None) -> FruitStream:
    return FruitStream(Measurer(MeasureOptions(instances="dataset")), fits=fits)


def test_a_stream_measures_as_measure_does_and_numbers_its_fruit(walk: list[Capture]) -> None:
    stream, measurer = by_masks(), Measurer(MeasureOptions(instances="dataset"))
    for k, capture in enumerate(walk):
        frame = stream.take(capture)
        assert [one.track for one in frame.fruit] == [1, 2, 3]
        assert [one.seen_frames for one in frame.fruit] == [k + 1] * 3
        assert frame.result.rows() == measurer.measure(capture).rows()
    lengths = [one.length for one in frame.fruit if one.length is not None]
    assert lengths
    for one, length in zip(frame.fruit, lengths, strict=False):
        measured = one.fruit.length
        assert measured is not None
        assert length.low_m < measured.value_m < length.high_m  # type: ignore[operator]
        assert one.frames == 4


def test_a_line_holds_the_fields_of_the_tables(walk: list[Capture]) -> None:
    stream = by_masks()
    line = stream.take(walk[0], received_s=0.0, dropped=7).as_json()
    assert json.loads(json.dumps(line)) == line
    known = {one.name for one in (*FIELDS, *TRACK_FIELDS, *FRAME_FIELDS)}
    assert set(line) - {"fruit", "version"} <= known
    assert (line["capture"], line["timestamp_s"], line["dropped"]) == ("walk_0", 1e9, 7)
    assert line["simulated"] is True
    assert line["latency_s"] > 0
    for fruit in line["fruit"]:
        assert set(fruit) - {"pose"} <= known
        assert fruit["pose"]["stem_m"][2] == pytest.approx(fruit["stem_z_m"], abs=1e-4)
        assert fruit["track_length_cm"] == pytest.approx(fruit["length_cm"])


def test_lines_keep_their_schema(walk: list[Capture]) -> None:
    schema = line_model().model_json_schema(mode="serialization")
    stream = by_masks()
    lines = [stream.take(one, received_s=0.0).as_json() for one in walk[:2]]
    for line in lines:
        jsonschema.validate(line, schema)
        assert set(line) <= set(schema["properties"])
        assert set(line["fruit"][0]) <= set(schema["$defs"]["StreamedFruit"]["properties"])
    for wrong in ({"version": 2}, {"latency_s": "late"}, {"fruit": [{"track": 1.5}]}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**lines[0], **wrong}, schema)


def test_a_fruit_seen_from_the_same_place_waits_when_one_is_measured_a_frame(
    walk: list[Capture],
) -> None:
    stream = by_masks(fits=1)
    measured = []
    for k in range(14):
        frame = stream.take(walk[0], at_s=k / 15)
        own = [one for one in frame.fruit if one.fruit.reason is not Choice.WAITING]
        assert all(one.fruit.length is None for one in frame.fruit if one not in own)
        measured.append([one.track for one in own])
    # Each once, and again after ten frames in which there was nothing new to see of it.
    assert sorted(measured[:3]) == [[1], [2], [3]]
    assert measured[3:11] == [[]] * 8
    assert measured[11:] == measured[:3]
    # A step back by 15 % of the distance is another place.
    moved = replace(walk[0], depth_m=walk[0].depth_m * np.float32(1.15))
    frame = stream.take(moved, at_s=1.0)
    assert sum(one.fruit.reason is not Choice.WAITING for one in frame.fruit) == 1


def test_frames_without_a_time_are_not_forgotten_because_networks_loaded(
    walk: list[Capture],
) -> None:
    stream = by_masks(fits=0)
    for capture, received_s in zip(walk, (0.0, 60.0, 60.1, 60.2), strict=True):
        frame = stream.take(replace(capture, timestamp_s=None), received_s=received_s)
        assert [one.track for one in frame.fruit] == [1, 2, 3]
    # With times of their own, a minute is a minute.
    late = replace(walk[0], timestamp_s=1e9)
    assert [one.track for one in stream.take(late).fruit] == [4, 5, 6]


def test_captures_of_different_stops_share_no_fruit() -> None:
    # Three scenes of a row, a stop each, that give no time: fruit lie at like places in them.
    given = by_masks().follow(open_stream(example_captures()))
    numbers = [
        [one.track for one in frame.fruit] for frame in given if not isinstance(frame, Failure)
    ]
    assert numbers == [[1, 2, 3], [4, 5, 6], [7, 8]]


def test_pictures_of_different_scenes_share_no_fruit_without_stops_either() -> None:
    stream, numbers = by_masks(), []
    for ref in open_source(example_captures()):
        frame = stream.take(replace(ref.load(), stop=Stop()))
        assert all(one.seen_frames == 1 and one.frames <= 1 for one in frame.fruit)
        numbers += [one.track for one in frame.fruit]
    assert numbers == list(range(1, 9))


def test_a_length_that_contradicts_is_another_fruits(walk: list[Capture]) -> None:
    stream = by_masks()
    first = stream.take(walk[0])
    # One fruit of three is replaced by its half; the others are who they were.
    masks = list(walk[1].masks)
    rows = np.flatnonzero(masks[0].any(axis=1))
    masks[0] = masks[0].copy()
    masks[0][rows[len(rows) // 2] :] = False
    depth_m = np.where(walk[1].masks[0] & ~masks[0], np.float32(1.5), walk[1].depth_m)
    frame = stream.take(replace(walk[1], masks=tuple(masks), depth_m=depth_m))
    assert [one.track for one in frame.fruit] == [4, 2, 3]
    new = frame.fruit[0]
    assert new.length is not None
    assert new.fruit.length is not None
    assert new.length.value_m == pytest.approx(new.fruit.length.value_m)
    assert first.fruit[0].length is not None
    assert new.length.value_m < 0.8 * first.fruit[0].length.value_m
    again = stream.take(replace(walk[2], masks=walk[2].masks[1:]))
    assert [one.track for one in again.fruit] == [2, 3]


def test_a_length_of_which_nothing_is_known_changes_no_tracks(walk: list[Capture]) -> None:
    """Too near, a camera reads an eighth of a fruit's pixels, and these too far to one side."""
    stream = by_masks()
    before = stream.take(walk[0]).fruit[0]
    mask = walk[1].masks[0]
    read = np.random.default_rng(3).random(mask.shape) < 0.12
    depth_m = np.where(mask, np.where(read, 1.2 * walk[1].depth_m, 0.0), walk[1].depth_m)
    near = stream.take(replace(walk[1], depth_m=depth_m.astype(np.float32))).fruit[0]
    assert near.fruit.length is not None
    assert before.length is not None
    assert "depth-sparse" in near.fruit.flags
    assert near.fruit.length.value_m > 1.1 * before.length.value_m
    assert (near.track, near.frames, near.length) == (1, 1, before.length)


@pytest.mark.parametrize("count", [2, 8])
def test_frames_searched_ahead_give_the_lines_of_frames_in_turn(
    folder: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """Order, tracks and lengths are the same; only another thread searches."""
    monkeypatch.setattr("cucumbervision.stream.fruit_stream.cores", lambda: count)
    (folder / "walk_2" / "depth_000000.png").write_bytes(b"\x89PNG no more")
    stream, threads = by_masks(fits=1), set()
    detect = stream.measurer.detect

    def watched(capture: Capture) -> tuple[Capture, Detections]:
        threads.add(threading.current_thread().name)
        return detect(capture)

    monkeypatch.setattr(stream.measurer, "detect", watched)
    frames = list(stream.follow(open_stream(folder)))
    assert threads == ({"ahead"} if count == 8 else {"MainThread"})
    alone = by_masks(fits=1)
    lines = [
        frame.message if isinstance(frame, Failure) else frame.as_json() | {"latency_s": 0}
        for frame in frames
    ]
    captures = [arrival.item for arrival in open_stream(folder)]
    assert lines == [
        item.message if isinstance(item, Failure) else alone.take(item).as_json() | {"latency_s": 0}
        for item in captures
    ]


def test_a_fault_in_searching_is_a_failure_of_its_frame(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cucumbervision.stream.fruit_stream.cores", lambda: 8)
    stream = by_masks()
    detect = stream.measurer.detect

    def faulty(capture: Capture) -> tuple[Capture, Detections]:
        if capture.name == "walk_1":
            raise CaptureError("no light")
        return detect(capture)

    monkeypatch.setattr(stream.measurer, "detect", faulty)
    given = list(stream.follow(open_stream(folder)))
    assert [type(one) for one in given] == [StreamedFrame, Failure, StreamedFrame, StreamedFrame]
    assert isinstance(given[1], Failure)
    assert (given[1].capture, given[1].error) == ("walk_1", "CaptureError")


def test_a_recording_is_streamed(recording: Path) -> None:
    every = [one.item for one in open_stream(recording, every_frame=True)]
    assert [one.frame for one in every if isinstance(one, Capture)] == list(range(1, 23))
    # As a camera, whoever takes each at once gets all that were not dropped meanwhile.
    arrivals = list(open_stream(recording))
    assert len(arrivals) + sum(one.dropped for one in arrivals) == 22
    last = arrivals[-1].item
    assert isinstance(last, Capture)
    assert last.frame == 22


def test_a_folder_that_fills_is_a_camera(walk: list[Capture], tmp_path: Path) -> None:
    write_native(walk[0], tmp_path / "old")
    naps = iter(walk[1:3])

    def sleep(_: float) -> None:
        # Another program writes while the camera waits; the last one breaks off.
        capture = next(naps, None)
        if capture is not None:
            write_native(capture, tmp_path / capture.name)
        else:
            (tmp_path / "half").mkdir(exist_ok=True)
            (tmp_path / "half" / "capture.json").write_text('{"format": "cucumber')

    ticks = iter(np.arange(0.0, 1e6, 0.5).tolist())
    clock: Callable[[], float] = lambda: next(ticks)  # noqa: E731 - a clock that runs by itself
    camera = FolderCamera(tmp_path, timeout_s=30.0, settle_s=2.0, clock=clock, sleep=sleep)
    names: list[str] = []
    with pytest.raises(CameraError, match="no capture has appeared for 30 s"):
        names.extend(
            one.item.name if isinstance(one.item, Capture) else one.item.error
            for one in stream_camera(lambda: camera, every_frame=True)
        )
    assert names == ["walk_1", "walk_2", "CaptureError"]


def test_the_command_prints_a_line_a_frame(folder: Path) -> None:
    code = "from cucumbervision.cli.app import main; main()"
    (folder / "walk_2" / "capture.json").write_text("{}")
    command = [sys.executable, "-c", code, "stream", str(folder), "--instances", "dataset"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 1, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["capture"] for line in lines] == ["walk_0", "walk_1", "walk_3"]
    assert [one["track"] for one in lines[-1]["fruit"]] == [1, 2, 3]
    assert "walk_2" in done.stderr
    assert "3 frames, 0 dropped" in done.stderr


class Camera:
    """Sends numbers when it is told to, and knows when it was let go."""

    def __init__(self) -> None:
        self.go, self.sent, self.gone = (threading.Semaphore(0) for _ in range(3))

    def frames(self, error: Exception | None = None, most: int = 100) -> Iterator[int]:
        try:
            for number in range(most):
                self.go.acquire()
                yield number
                # Asked for the next: this one is in the inbox.
                self.sent.release()
            if error is not None:
                raise error
        finally:
            self.gone.release()

    def send(self, count: int) -> None:
        for _ in range(count):
            self.go.release()
            assert self.sent.acquire(timeout=30)


def test_who_is_slow_gets_the_newest_and_the_count_of_the_others() -> None:
    camera = Camera()
    stream = newest_first(camera.frames())
    camera.go.release()
    first = next(stream)
    assert (first.item, first.dropped) == (0, 0)
    assert camera.sent.acquire(timeout=30)
    camera.send(5)  # 1 to 5, none of them taken
    late = next(stream)
    assert (late.item, late.dropped) == (5, 4)
    assert late.received_s > first.received_s


def test_an_error_comes_after_the_last_frame() -> None:
    camera = Camera()
    stream = newest_first(camera.frames(CameraError("unplugged"), most=2))
    camera.go.release()
    assert next(stream).item == 0
    camera.go.release()
    assert camera.gone.acquire(timeout=30)
    assert next(stream).item == 1
    with pytest.raises(CameraError, match="unplugged"):
        next(stream)


def test_a_stream_that_is_left_lets_its_camera_go() -> None:
    camera = Camera()
    stream = newest_first(camera.frames())
    camera.go.release()
    assert next(stream).item == 0
    stream.close()  # type: ignore[attr-defined]
    camera.go.release()  # the next frame finds nobody
    assert camera.gone.acquire(timeout=30)


def test_one_result_at_most_waits_and_its_successor_is_not_begun() -> None:
    begun: list[int] = []
    third = threading.Event()

    def work(number: int) -> int:
        begun.append(number)
        if number == 3:
            third.set()
        return 10 * number

    results = ahead(iter(range(1, 9)), work)
    assert next(results) == 10
    assert next(results) == 20  # taken: the third is begun, and the fourth is not
    assert third.wait(timeout=30)
    assert begun == [1, 2, 3]
    assert list(results) == [30, 40, 50, 60, 70, 80]


def test_a_failing_source_or_function_ends_after_the_last_result() -> None:
    def source() -> Iterator[int]:
        yield from (1, 2)
        raise CameraError("unplugged")

    results = ahead(source(), str)
    assert [next(results), next(results)] == ["1", "2"]
    with pytest.raises(CameraError, match="unplugged"):
        next(results)
    quotients = ahead([1, 0, 2], lambda number: 1 // number)
    assert next(quotients) == 1
    with pytest.raises(ZeroDivisionError):
        next(quotients)


def test_who_leaves_waits_for_work_and_not_for_a_silent_source() -> None:
    camera = Camera()
    working, go_on, ended = (threading.Event() for _ in range(3))

    def work(number: int) -> int:
        if number:
            working.set()
            assert go_on.wait(timeout=30)
            ended.set()
        return number

    results = ahead(camera.frames(), work)
    camera.go.release()
    assert next(results) == 0
    camera.go.release()
    assert working.wait(timeout=30)
    threading.Timer(0.2, go_on.set).start()
    results.close()  # type: ignore[attr-defined]
    assert ended.is_set()
    assert camera.gone.acquire(timeout=30)
    silent = Camera()
    words = ahead(silent.frames(), str)
    silent.go.release()
    assert next(words) == "0"
    words.close()  # type: ignore[attr-defined]
    silent.go.release()  # the next frame finds nobody
    assert silent.gone.acquire(timeout=30)


def test_a_recording_keeps_the_pace_of_its_camera() -> None:
    black = Capture(
        np.zeros((4, 4, 3), np.uint8),
        np.zeros((4, 4), np.float32),
        Intrinsics(4, 4, 4.0, 4.0, 2.0, 2.0),
        "a",
    )
    # Set back after the third; the fourth comes at once, and the last after a long pause.
    times = [10.0, 10.1, 10.3, 9.0, 500.0]
    now, waits = [0.0], []

    def sleep(seconds: float) -> None:
        waits.append(round(seconds, 6))
        now[0] += seconds

    frames = [replace(black, timestamp_s=time_s) for time_s in times]
    assert list(paced(frames, lambda: now[0], sleep)) == frames
    assert waits == [0.1, 0.2, 2.0]
