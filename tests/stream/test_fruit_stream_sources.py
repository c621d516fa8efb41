from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CameraError
from cucumbervision.stream.fruit_stream import ahead, newest_first, paced


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
