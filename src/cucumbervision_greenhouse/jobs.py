"""Background work: a queue of jobs done by one thread, and the progress of a round."""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any

from cucumbervision.errors import CucumberVisionError
from cucumbervision_greenhouse.language import counted, words_of
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.store.waiting import Waiting


def fault_of(future: Future[Any]) -> str:
    """Return why work failed, for people; empty while it runs or if it succeeded."""
    error = future.exception() if future.done() else None
    if error is None or isinstance(error, CucumberVisionError):
        return words_of(error or "")
    return f"{type(error).__name__}: {error}"


@dataclass(eq=False)
class Job:
    """One piece of work and its progress.

    Parameters
    ----------
    title : str
        What it is, for people.
    round_key : str, optional
        The round that it works on; empty for none, None for captures of any, which `progress_of`
        counts.
    total, done : int
        Steps; a total of 0 where it is not known.
    measured : dict of str
        Captures that became stops, by key, each with its round.
    """

    title: str
    round_key: str | None = ""
    total: int = 0
    done: int = 0
    measured: dict[str, str] = field(default_factory=dict)
    future: Future[Any] = field(default_factory=Future, repr=False)

    @property
    def finished(self) -> bool:
        """Whether it is done or failed."""
        return self.future.done()

    @property
    def error(self) -> str:
        """Why it failed; empty if it did not."""
        return fault_of(self.future)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is finished; return whether it is."""
        return bool(wait([self.future], timeout_s).done)


class JobQueue:
    """A thread that does one job after the other, in the order of submission.

    Networks and fits compute outside Python's global lock for most of the time, so a thread does
    not block the pages. There is only one, since two would share the same cores.

    Examples
    --------
    >>> worker = JobQueue()
    >>> worker.submit("adding", lambda job: 1 + 1).future.result()
    2
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="measuring", initializer=give_way)
        self._jobs: list[Job] = []
        self.finished = 0

    def submit(self, title: str, work: Callable[[Job], Any], round_key: str | None = "") -> Job:
        """Queue a job; `work` is given the job, to count its steps; the rest as `Job`."""
        job = Job(title, round_key)
        self._jobs.append(job)
        job.future = self._pool.submit(_run, work, job)
        job.future.add_done_callback(lambda _: self._end(job))
        return job

    def _end(self, job: Job) -> None:
        self._jobs.remove(job)
        self.finished += 1

    def unfinished(self) -> list[Job]:
        """Return the jobs that wait or run, in their order."""
        return [job for job in list(self._jobs) if not job.finished]


_GIVEN_UP_S = 0.001  # how long one thread may keep Python's lock from the others; 5 ms by default
_LESS_URGENT = 10  # steps of 'nice'


def give_way() -> None:
    """Lower this thread's priority below the camera's and the pages'."""
    sys.setswitchinterval(_GIVEN_UP_S)
    if sys.platform == "linux":  # a thread and those that it starts have their own priority
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LESS_URGENT)


def _run(work: Callable[[Job], Any], job: Job) -> Any:
    try:
        return work(job)
    except CucumberVisionError:
        raise
    except Exception:
        # The page shows one line; the traceback goes to the log.
        logging.getLogger(__name__).exception("job %s failed", job.title)
        raise


@dataclass(frozen=True)
class Progress:
    """The progress of a round, as browsers get it.

    Parameters
    ----------
    words : str
        The current work; empty if there is none.
    first : str
        The text in place of the stops of an empty round; empty if no stop is to come.
    done, total : int
        Steps of the bar; a total of 0 is unknown.
    waiting : int
        Captures of the round that are saved and not yet measured.
    """

    words: str = ""
    first: str = ""
    done: int = 0
    total: int = 0
    waiting: int = 0

    @property
    def news(self) -> dict[str, Any]:
        """The progress as JSON."""
        return asdict(self)


def progress_of(
    round_key: str,
    captures: Iterable[Waiting],
    aside: Iterable[Waiting] = (),
    measured: Mapping[str, str] | None = None,
    jobs: Iterable[Job] = (),
    fault: str = "",
) -> Progress:
    """Return the work on a round.

    Parameters
    ----------
    round_key : str
        The round.
    captures : iterable of Waiting
        The queue, of all rounds.
    aside : iterable of Waiting
        Those that are not tried again, of all rounds.
    measured : mapping of str to str
        Captures of the queue that were measured since it was empty, by key, each with its round.
    jobs : iterable of Job
        Those that wait or run, in their order.
    fault : str
        Why the queue cannot be measured; empty where it can.
    """
    stops, first, words = measured or {}, "", ""
    queued = [capture.round_key == round_key for capture in captures if capture.key not in stops]
    waiting, elsewhere = sum(queued), len(queued) - sum(queued)
    done = list(stops.values()).count(round_key) if waiting else 0
    job = next((candidate for candidate in jobs if candidate.round_key in ("", round_key)), None)
    if waiting:
        first = counted(
            waiting,
            "{n} capture is saved, and not measured yet. Its results appear here.",
            "{n} captures are saved, and none is measured yet. Their results appear here.",
        )
        words = counted(
            waiting + done,
            "Measuring: {done} of {n} capture",
            "Measuring: {done} of {n} captures",
            done=done,
        )
    elif failed := sum(capture.round_key == round_key for capture in aside):
        first = counted(
            failed,
            "{n} capture could not be measured; it is kept beside the store.",
            "{n} captures could not be measured; they are kept beside the store.",
        )
    if waiting and fault:
        words = counted(
            waiting,
            "{n} capture waits to be measured: {fault}",
            "{n} captures wait to be measured: {fault}",
            fault=fault,
        )
    elif job is not None and not waiting:
        words = _("{title}: {done} of {all}") if job.total else "{title} …"
        words = words.format(title=_(job.title), done=job.done, all=job.total)
        return Progress(words, first, job.done, job.total)
    if elsewhere:
        others = counted(
            elsewhere, "{n} capture of other rounds waits", "{n} captures of other rounds wait"
        )
        words = "; ".join(filter(None, (words, others)))
    return Progress(words, first, done, waiting + done, waiting)
