"""The loop over captures: each is read, searched and measured, and outcomes are yielded in order.

Every caller combines a source of captures, a `Worker` that converts each result, and a loop over
the outcomes of `measure_all`. Failures are values: only a failure to load the networks or the
calibration ends the loop.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

from cucumbervision.capture.readers import open_source
from cucumbervision.errors import CaptureError
from cucumbervision.networks.runtime import limit_threads
from cucumbervision.run.inputs import Listed
from cucumbervision.run.measurer import Boundary, CaptureResult, Failure, Measurer

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Capture
    from cucumbervision.run.inputs import Opener

T = TypeVar("T")
ItemT = TypeVar("ItemT", bound="Listed | Failure")
Item: TypeAlias = Listed | Failure
"""A capture that is to be measured, or why there is none."""


@dataclass(frozen=True, eq=False)
class Outcome(Generic[T]):
    """The outcome of one capture, or of an input that could not be listed.

    Parameters
    ----------
    value : object, optional
        The worker's result. None without a failure: the capture needed no work, or the loop was
        cancelled before its turn.
    failures : tuple of Failure
        The failures.
    """

    value: T | None = None
    failures: tuple[Failure, ...] = ()


class Worker(ABC, Generic[T]):
    """Does the work of one capture, in this process or as a copy in another.

    Parameters
    ----------
    measurer : Measurer
        The measurer; its networks are loaded with the first capture.
    """

    def __init__(self, measurer: Measurer) -> None:
        self.measurer = measurer

    def __call__(self, item: Item) -> Outcome[T]:
        """Read and measure one item; errors are returned in the outcome.

        Raises
        ------
        CucumberVisionError
            If the networks or the calibration cannot be loaded, as `Measurer.load`.
        """
        read = self.read(item)
        return read if isinstance(read, Outcome) else self.measure(read)

    def read(self, item: Item) -> Outcome[T] | Capture:
        """Read a capture; an outcome means that there is nothing to measure."""
        if isinstance(item, Failure):
            return Outcome(failures=(item,))
        failures: list[Failure] = []
        with Boundary(failures, item.input, item.name):
            return replace(item.ref.load(), name=item.name)
        return Outcome(failures=tuple(failures))

    @abstractmethod
    def measure(self, capture: Capture) -> Outcome[T]:
        """Measure a capture, and convert the result."""


class ResultWorker(Worker[CaptureResult]):
    """Returns results unchanged; a capture that could not be measured has an `error`."""

    def measure(self, capture: Capture) -> Outcome[CaptureResult]:
        """Measure a capture."""
        self.measurer.load()
        result = self.measurer.attempt(capture)
        return Outcome(result, result.failures)


Engine: TypeAlias = Callable[
    [Iterable[Item], Worker[Any], Callable[[], bool]], Iterator[Outcome[Any]]
]
"""Processes all items, and yields the outcome of each, in order, when it is available.

An engine that takes all items at once starts no further one after the function returns True.
"""


def in_turn(
    items: Iterable[Item], worker: Worker[Any], _: Callable[[], bool]
) -> Iterator[Outcome[Any]]:
    """Process one item after the other, and request the next only when the previous one is done."""
    yield from map(worker, items)


def in_process(
    items: Iterable[Item], worker: Worker[Any], _: Callable[[], bool]
) -> Iterator[Outcome[Any]]:
    """Process two items at once in this process: the networks find one's fruit meanwhile."""
    with ThreadPoolExecutor(2) as threads:
        yield from _in_order(items, lambda item: threads.submit(worker, item).result, 2)


def _in_order(
    items: Iterable[Item], submit: Callable[[Item], Callable[[], Outcome[Any]]], most_running: int
) -> Iterator[Outcome[Any]]:
    """Yield outcomes in the order of the items, of which some are submitted ahead."""
    remaining, running = iter(items), deque[Callable[[], Outcome[Any]]]()
    while True:
        running.extend(map(submit, islice(remaining, most_running - len(running))))
        if not running:
            return
        yield running.popleft()()


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Processes:
    """Processes items in several processes of this machine; each loads the networks once.

    Parameters
    ----------
    workers : int
        Number of processes; they share the cores of the machine.
    """

    workers: int

    def __call__(
        self, items: Iterable[Item], worker: Worker[Any], _: Callable[[], bool]
    ) -> Iterator[Outcome[Any]]:
        """Process the items; at most two per worker are running or queued.

        If a process is killed, its captures are measured again, each in a separate process. A
        capture whose process is killed twice becomes a failure.
        """
        pool = _Pool(self.workers, worker)
        try:
            yield from _in_order(items, pool.submit, 2 * self.workers)
        finally:
            pool.close()


class _Pool:
    """A pool of processes with a worker each; it is restarted if one of them is killed."""

    def __init__(self, workers: int, worker: Worker[Any]) -> None:
        self._workers, self._worker = workers, worker
        self._pool = self._new(workers)

    def _new(self, workers: int) -> ProcessPoolExecutor:
        # Forking a process that runs threads of OpenCV or a runtime may hang.
        context = multiprocessing.get_context("spawn")
        threads = max(1, cores() // self._workers)
        return ProcessPoolExecutor(workers, context, _begin, (self._worker, threads))

    def submit(self, item: Item) -> Callable[[], Outcome[Any]]:
        """Submit an item, and return what waits for its outcome."""
        ready = portable(item)
        try:
            future = self._pool.submit(_do, ready)
        except BrokenProcessPool:
            self.close()
            self._pool = self._new(self._workers)
            future = self._pool.submit(_do, ready)
        return partial(self._result, ready, future)

    def _result(self, item: Item, future: Future[Outcome[Any]]) -> Outcome[Any]:
        try:
            return future.result()
        except BrokenProcessPool:
            with self._new(1) as alone:
                try:
                    return alone.submit(_do, item).result()
                except BrokenProcessPool:
                    return outcome_of_killed(item)

    def close(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


def outcome_of_killed(item: Item) -> Outcome[Any]:
    """Return the outcome of a capture whose process was killed twice."""
    if isinstance(item, Failure):
        return Outcome(failures=(item,))
    error = CaptureError(
        "the process that measured it was killed twice",
        source=item.name,
        remedy="look whether there is enough memory, and room on the disk for temporary files, or "
        "measure it alone",
    )
    return Outcome(failures=(Failure.of(error, item.input, item.name),))


def portable(item: Item) -> Item:
    """Return an item that another process can handle, or the failure."""
    if isinstance(item, Failure):
        return item
    failures: list[Failure] = []
    with Boundary(failures, item.input, item.name):
        return item.portable()
    return failures[0]


_worker: list[Worker[Any]] = []  # the worker of this process


def _begin(worker: Worker[Any], threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command stops its workers
    threading.Thread(target=end_with_parent, daemon=True).start()
    limit_threads(threads)
    _worker.append(worker)


def _do(item: Item) -> Outcome[Any]:
    return _worker[0](item)


def end_with_parent() -> None:
    """End this process if the command was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def never() -> bool:
    """Return False: never stop the loop."""
    return False


@dataclass(frozen=True)
class LoopOptions:
    """Options of the loop, which do not change results.

    Parameters
    ----------
    opener : callable
        Opens each input.
    engine : Engine
        Where captures are processed.
    is_cancelled : callable
        Called before each capture; if it returns True, no further capture is started.
    """

    opener: Opener = open_source
    engine: Engine = in_process
    is_cancelled: Callable[[], bool] = never


def measure_all(
    items: Iterable[ItemT],
    worker: Worker[T],
    engine: Engine = in_process,
    is_cancelled: Callable[[], bool] = never,
) -> Iterator[tuple[ItemT, Outcome[T]]]:
    """Measure captures, and yield each item with its outcome, in order.

    Parameters
    ----------
    items : iterable of Listed or Failure
        The captures; failures are passed through in order.
    worker : Worker
        Reads and measures each capture, and converts the result.
    engine : Engine
        Where captures are processed: `in_turn`, `in_process`, `Processes` or a `RayEngine`.
    is_cancelled : callable
        Once it returns True, running captures are finished and no more are started.

    Raises
    ------
    CucumberVisionError
        If a network or the calibration cannot be loaded.

    Examples
    --------
    >>> from cucumbervision import MeasureOptions, example_captures
    >>> from cucumbervision.run.inputs import list_captures
    >>> worker = ResultWorker(Measurer(MeasureOptions(instances="dataset", methods=("M1",))))
    >>> listed = list_captures([example_captures()], worker.measurer.options.reading)
    >>> [(ref.name, len(outcome.value.fruit)) for ref, outcome in measure_all(listed, worker)]
    [('simulated-bench', 3), ('simulated-row-a', 3), ('simulated-row-b', 2)]
    """
    begun = deque[tuple[ItemT, bool]]()

    def started() -> Iterator[ItemT]:
        for item in items:
            is_dropped = isinstance(item, Listed) and is_cancelled()
            begun.append((item, is_dropped))
            if not is_dropped:
                yield item

    for outcome in engine(started(), worker, is_cancelled):
        while begun[0][1]:
            yield begun.popleft()[0], Outcome()
        yield begun.popleft()[0], outcome
    yield from ((item, Outcome()) for item, _ in begun)
