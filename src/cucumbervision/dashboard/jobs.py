"""Work beside the pages: one worker thread, jobs with progress, none of which blocks a page."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, TypeAlias

from cucumbervision.errors import CucumberVisionError

__all__ = ["Job", "JobState", "Worker"]

KEPT = 20  # finished jobs whose results are still held


class JobState(StrEnum):
    """How far a job is."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


@dataclass
class Job:
    """One piece of work, and how far it is.

    Parameters
    ----------
    number : int
        Its number.
    title : str
        What it is, for people.
    total, done : int
        Steps; 0 in all where nobody knows.
    notes : list of str
        What went wrong along the way without ending it, one line each.
    result : object
        What it gave.
    error : str
        Why it failed.
    """

    number: int
    title: str
    state: JobState = JobState.WAITING
    total: int = 0
    done: int = 0
    notes: list[str] = field(default_factory=list)
    result: Any = None
    error: str = ""
    finished: threading.Event = field(default_factory=threading.Event, repr=False)

    @property
    def share(self) -> float:
        """How much of it is done, 0 to 1."""
        if self.state is JobState.DONE:
            return 1.0
        return min(self.done / self.total, 1.0) if self.total else 0.0

    def step(self, note: str = "") -> None:
        """Count one step, and note what went wrong with it."""
        self.done += 1
        if note:
            self.notes.append(note)


Work: TypeAlias = Callable[[Job], Any]


class Worker:
    """A thread that does one job after the other, in the order in which they come.

    Networks and fits compute outside Python's lock for most of the time, so a thread leaves the
    pages free; one only, since two would share the same cores.

    Examples
    --------
    >>> with Worker() as worker:
    ...     job = worker.submit("adding", lambda job: 1 + 1)
    ...     job.finished.wait(5), str(job.state), job.result
    (True, 'done', 2)
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="measuring")
        self._jobs: OrderedDict[int, Job] = OrderedDict()
        self._lock = threading.Lock()
        self._next = 1

    def submit(self, title: str, work: Work) -> Job:
        """Queue a job; `work` is given the job, to count its steps."""
        with self._lock:
            job = Job(self._next, title)
            self._next += 1
            self._jobs[job.number] = job
            old = [n for n, one in self._jobs.items() if one.finished.is_set()]
            for number in old[: max(0, len(old) - KEPT)]:
                del self._jobs[number]
        self._pool.submit(_run, job, work)
        return job

    def get(self, number: int | None) -> Job | None:
        """Give a job by its number; None where it is not held any more."""
        return None if number is None else self._jobs.get(number)

    def unfinished(self) -> list[Job]:
        """List the jobs that wait or run, in their order."""
        with self._lock:
            return [job for job in self._jobs.values() if not job.finished.is_set()]

    def close(self) -> None:
        """Finish the job at hand and drop the rest."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _run(job: Job, work: Work) -> None:
    job.state = JobState.RUNNING
    try:
        job.result = work(job)
        job.state = JobState.DONE
    except CucumberVisionError as error:
        job.error, job.state = str(error), JobState.FAILED
    except Exception as error:
        # A thread's exception would vanish; the page shows it, and the traceback is logged.
        import logging

        logging.getLogger(__name__).exception("job %s failed", job.title)
        job.error, job.state = f"{type(error).__name__}: {error}", JobState.FAILED
    finally:
        job.finished.set()
