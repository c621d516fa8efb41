from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
import scipy.linalg  # noqa: F401
from threadpoolctl import threadpool_info, threadpool_limits

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance
from cucumbervision.methods.result import LengthKind, Measurement
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.methods.table import Region, TableMethod
from cucumbervision.tube.compiled import OneThread

Seen = list[set[int]]


@pytest.fixture(scope="module")
def process() -> Iterator[ProcessPoolExecutor]:
    """A process of its own: the limit is the process's, and another test's threads may measure."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        yield pool


def blas_threads() -> set[int]:
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def with_three_threads(seen: Callable[[], Seen]) -> Seen:
    """Return what a function saw where the user set three threads, and what is set after it."""
    with threadpool_limits(3, user_api="blas"):
        return [*seen(), blas_threads()]


class Observer:
    """A method of one's own that looks at the threads."""

    name, title, kind = "observer", "looks at the threads", LengthKind.BOX_CHORD

    def __init__(self) -> None:
        self.during: Seen = []

    def measure(self, region: Region) -> Measurement:
        self.during.append(blas_threads())
        return TableMethod.of("M2").measure(region)


def while_a_fruit_is_measured() -> Seen:
    observer = Observer()
    lens = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    depth = np.full((480, 640), 0.6, np.float32)
    capture = Capture(np.zeros((480, 640, 3), np.uint8), depth, lens, "a")
    box = np.array([219.5, 229.5, 419.5, 249.5])
    fruit = measure_fruit(capture, Instance(box), ("M2", observer))
    assert fruit.length is not None
    return observer.during


def after_the_first_of_two_blocks() -> Seen:
    # As of two threads of a program, of which the first to begin is the first to end.
    first, second = OneThread(), OneThread()
    first.__enter__()
    second.__enter__()
    first.__exit__()
    between = blas_threads()
    second.__exit__()
    return [between]


def while_an_error_is_raised() -> Seen:
    with pytest.raises(np.linalg.LinAlgError), OneThread():
        np.linalg.inv(np.zeros((2, 2)))
    return []


@pytest.mark.parametrize(
    ("seen", "expected"),
    [
        (while_a_fruit_is_measured, [{1}]),
        (after_the_first_of_two_blocks, [{1}]),
        (while_an_error_is_raised, []),
    ],
)
def test_one_thread_inside_and_the_users_setting_after_it(
    process: ProcessPoolExecutor, seen: Callable[[], Seen], expected: Seen
) -> None:
    assert process.submit(with_three_threads, seen).result(timeout=120) == [*expected, {3}]
