"""Where the work of many captures is done: in this process, or in several of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, TypeAlias

from cucumbervision.errors import CaptureError, CucumberVisionError
from cucumbervision.perception.runtime import limit_threads
from cucumbervision.pipeline.measurer import Failure
from cucumbervision.pipeline.work import Batch, Outcome, ReadCapture, Task, Worker

if TYPE_CHECKING:
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.pipeline.output import OutputFolder

Engine: TypeAlias = Callable[[Batch], Iterator[Outcome]]
"""Does a batch, and yields the outcome of each task, in order, as they are done."""


def in_process(batch: Batch) -> Iterator[Outcome]:
    """Do tasks one after the other in this process.

    While networks look at one capture, the next is read and the one before is measured.
    """
    worker = Worker(batch.options, batch.out)
    waiting: deque[tuple[Task, Future[Outcome | ReadCapture]] | Outcome] = deque()
    seen: deque[Future[Outcome] | Outcome] = deque()
    begun = False

    def look() -> None:
        one = waiting.popleft()
        if isinstance(one, Outcome):
            seen.append(one)
        elif not batch.stop() or one[0].trusted:
            seen.append(measuring.submit(worker.measure, worker.detect(one[1].result())))
        elif dropped := one[0].dropped():
            seen.append(dropped)

    def measured(ahead: int) -> Iterator[Outcome]:
        nonlocal begun
        # The first result comes at once: somebody waits for it.
        while len(seen) > (ahead if begun else 0):
            begun = True
            one = seen.popleft()
            yield one if isinstance(one, Outcome) else one.result()

    with ThreadPoolExecutor(1) as reading, ThreadPoolExecutor(1) as measuring:
        for task in batch.tasks:
            if isinstance(task, Outcome):
                waiting.append(task)
            else:
                waiting.append((task, reading.submit(worker.read, task)))
            if len(waiting) > 1:
                look()
                yield from measured(ahead=1)
        while waiting:
            look()
            yield from measured(ahead=1)
        yield from measured(ahead=0)


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Processes:
    """Does tasks in several processes of this machine; each loads the networks once.

    Parameters
    ----------
    workers : int
        How many; they share the machine's cores among them.
    """

    workers: int

    def __call__(self, batch: Batch) -> Iterator[Outcome]:
        """Do the tasks: at most two a worker are begun or wait for their turn.

        A process that is killed costs no row: what it had is done again in a process of its own,
        and is a failure if that one is killed, too.
        """
        pool = _Pool(self.workers, batch.options, batch.out)
        waiting: deque[tuple[Task, Future[Outcome]] | Outcome] = deque()

        def first() -> Iterator[Outcome]:
            one = waiting.popleft()
            if isinstance(one, Outcome):
                yield one
            elif batch.stop() and not one[0].trusted and one[1].cancel():
                dropped = one[0].dropped()
                yield from () if dropped is None else (dropped,)
            else:
                yield pool.result(*one)

        try:
            for task in batch.tasks:
                ready = task if isinstance(task, Outcome) else task.portable()
                waiting.append(ready if isinstance(ready, Outcome) else (ready, pool.submit(ready)))
                if len(waiting) > 2 * self.workers:
                    yield from first()
            while waiting:
                yield from first()
        finally:
            pool.close()


class _Pool:
    """Processes with a worker each, made anew when one of them was killed."""

    def __init__(self, workers: int, options: MeasureOptions, out: OutputFolder) -> None:
        self._workers, self._options, self._out = workers, options, out
        self._pool = self._new(workers)

    def _new(self, workers: int) -> ProcessPoolExecutor:
        # Forking a process that runs threads of OpenCV or a runtime may hang.
        context = multiprocessing.get_context("spawn")
        threads = max(1, cores() // self._workers)
        settings = self._options, self._out, threads
        return ProcessPoolExecutor(workers, context, _begin, settings)

    def submit(self, task: Task) -> Future[Outcome]:
        try:
            return self._pool.submit(_do, task)
        except BrokenProcessPool:
            self.close()
            self._pool = self._new(self._workers)
            return self._pool.submit(_do, task)

    def result(self, task: Task, future: Future[Outcome]) -> Outcome:
        try:
            return future.result()
        except BrokenProcessPool:
            with self._new(1) as alone:
                try:
                    return alone.submit(_do, task).result()
                except BrokenProcessPool:
                    return _outcome_of_killed(task)

    def close(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


def choose_engine(name: str, workers: int = 0, address: str = "") -> Engine:
    """Return what the command's options ask for.

    Parameters
    ----------
    name : str
        'local' or 'ray'.
    workers : int
        Processes; 0 for one, or with Ray for one a CPU.
    address : str
        Of the Ray cluster; empty for one on this machine.

    Raises
    ------
    CucumberVisionError
        If an address is given without Ray.
    """
    if name == "ray":
        from cucumbervision.pipeline.ray_engine import RayEngine

        return RayEngine(address, workers)
    if address:
        raise CucumberVisionError(
            "only a Ray cluster has an address", source="--address", remedy="add --engine ray"
        )
    return Processes(workers) if workers > 1 else in_process


def _outcome_of_killed(task: Task) -> Outcome:
    """Return the outcome of a task whose process was killed twice."""
    one = task.listed
    error = CaptureError(
        "the process that measured it was killed twice",
        source=one.name,
        remedy="look whether there is enough memory, or measure it alone",
    )
    return Outcome(
        one.input, one.name, task.place, failures=(Failure.of(error, one.input, one.name),)
    )


_worker: list[Worker] = []  # this process's


def _begin(options: MeasureOptions, out: OutputFolder, threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command ends its workers itself
    threading.Thread(target=_end_with_parent, daemon=True).start()
    limit_threads(threads)
    _worker.append(Worker(options, out))


def _do(task: Task) -> Outcome:
    return _worker[0](task)


def _end_with_parent() -> None:
    """End this process when the command has been killed: nobody would fetch its results."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
