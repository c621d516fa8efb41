"""One function of many jobs, on several processes."""

from __future__ import annotations

import multiprocessing
import os
import threading
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, TypeVar

import cv2

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

Job = TypeVar("Job")
Result = TypeVar("Result")


def each_done(
    function: Callable[[Job], Result], jobs: Sequence[Job], workers: int
) -> Iterator[Result]:
    """Yield what a function makes of each job, as they are done.

    Parameters
    ----------
    function : callable
        Can be pickled; runs with one thread of OpenCV in each process.
    jobs : sequence
        What it is called with.
    workers : int
        Processes; with one, or for one job, all is done in this one, in order.

    Yields
    ------
    object
        A result. After an error or an interruption no further job is begun.

    Examples
    --------
    >>> list(each_done(str, [1, 2], workers=1))
    ['1', '2']
    """
    if workers <= 1 or len(jobs) <= 1:
        yield from map(function, jobs)
        return
    # Forking a process that runs threads of OpenCV or Torch may hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _begin_worker) as pool:
        waiting = [pool.submit(function, job) for job in jobs]
        try:
            for job in as_completed(waiting):
                yield job.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the command has been killed: its results have no reader."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
