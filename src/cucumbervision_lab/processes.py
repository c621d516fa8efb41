"""Run a function for many jobs in several processes."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

import cv2

from cucumbervision.run.batch import end_with_parent

Job = TypeVar("Job")
Result = TypeVar("Result")


def each_done(
    function: Callable[[Job], Result], jobs: Sequence[Job], workers: int
) -> Iterator[Result]:
    """Yield the results of a function for each job as they complete.

    Parameters
    ----------
    function : callable
        Function that can be pickled; runs with one OpenCV thread per process.
    jobs : sequence
        Arguments of the calls.
    workers : int
        Number of processes. With one worker or one job, everything runs in this process, in order.

    Yields
    ------
    object
        A result. No further job is started after an error or an interruption.

    Examples
    --------
    >>> list(each_done(str, [1, 2], workers=1))
    ['1', '2']
    """
    if workers <= 1 or len(jobs) <= 1:
        yield from map(function, jobs)
        return
    # Forking a process with OpenCV or torch threads may deadlock.
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
    threading.Thread(target=end_with_parent, daemon=True).start()
