"""Background work: a queue of jobs with progress, done by one thread."""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from cucumbervision.errors import CucumberVisionError
from cucumbervision_greenhouse.core_words import words_of

KEPT = 20  # finished jobs whose results are still held


def fault_of(future: Future[Any]) -> str:
    """Return why work failed, for people; empty while it runs or if it succeeded."""
    error = future.exception() if future.done() else None
    if error is None or isinstance(error, CucumberVisionError):
        return words_of(error or "")
    return f"{type(error).__name__}: {error}"


@dataclass
class Job:
    """One piece of work and its progress.

    Parameters
    ----------
    number : int
        Its number.
    title : str
        What it is, for people.
    total, done : int
        Steps; a total of 0 where it is not known.
    notes : list of str
        What went wrong along the way without ending it, one line each.
    round_key : str, optional
        The round that it works on; empty for none, None for captures of any, which
        `progress.progress_of` counts.
    measured : dict of str
        Captures that became stops, by key, each with its round.
    """

    number: int
    title: str
    total: int = 0
    done: int = 0
    notes: list[str] = field(default_factory=list)
    round_key: str | None = ""
    measured: dict[str, str] = field(default_factory=dict)
    future: Future[Any] = field(default_factory=Future, repr=False)

    @property
    def finished(self) -> bool:
        """Whether it is done or failed."""
        return self.future.done()

    @property
    def result(self) -> Any:
        """What the work returned."""
        return self.future.result()

    @property
    def error(self) -> str:
        """Why it failed; empty if it did not."""
        return fault_of(self.future)

    def step(self, note: str = "") -> None:
        """Count one step, and note its fault, if any."""
        self.done += 1
        if note:
            self.notes.append(note)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is finished; return whether it is."""
        return bool(wait([self.future], timeout_s).done)


Work: TypeAlias = Callable[[Job], Any]


class JobQueue:
    """A thread that does one job after the other, in the order of submission.

    Networks and fits compute outside Python's global lock for most of the time, so a thread does
    not block the pages. There is only one, since two would share the same cores.

    Examples
    --------
    >>> with JobQueue() as worker:
    ...     job = worker.submit("adding", lambda job: 1 + 1)
    ...     job.wait(), job.result
    (True, 2)
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="measuring", initializer=give_way)
        self._jobs: OrderedDict[int, Job] = OrderedDict()
        self._lock = threading.Lock()
        self._next = 1
        self.finished = 0

    def submit(self, title: str, work: Work, round_key: str | None = "") -> Job:
        """Queue a job; `work` is given the job, to count its steps; the rest as `Job`."""
        with self._lock:
            job = Job(self._next, title, round_key=round_key)
            self._next += 1
            old = [number for number, job in self._jobs.items() if job.finished]
            for number in old[: max(0, len(old) - KEPT)]:
                del self._jobs[number]
            job.future = self._pool.submit(_run, work, job)
            job.future.add_done_callback(self._count)
            self._jobs[job.number] = job
        return job

    def _count(self, _: Future[Any]) -> None:
        self.finished += 1

    def get(self, number: int | None) -> Job | None:
        """Return a job by its number; None if it is no longer held."""
        return None if number is None else self._jobs.get(number)

    def unfinished(self) -> list[Job]:
        """Return the jobs that wait or run, in their order."""
        with self._lock:
            return [job for job in self._jobs.values() if not job.finished]

    def close(self) -> None:
        """Finish the current job and drop all others."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> JobQueue:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


_GIVEN_UP_S = 0.001  # how long one thread may keep Python's lock from the others; 5 ms by default
_LESS_URGENT = 10  # steps of 'nice'


def give_way() -> None:
    """Lower this thread's priority below the camera's and the pages'."""
    sys.setswitchinterval(_GIVEN_UP_S)
    if (
        sys.platform == "linux"
    ):  # on Linux a thread and those that it starts have their own priority
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LESS_URGENT)


def _run(work: Work, job: Job) -> Any:
    try:
        return work(job)
    except CucumberVisionError:
        raise
    except Exception:
        # The page shows one line; the traceback goes to the log.
        logging.getLogger(__name__).exception("job %s failed", job.title)
        raise
