"""Background work: a queue of jobs done by one thread, and the progress of a round."""

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
from typing import TYPE_CHECKING, Any, TypeAlias

from cucumbervision.errors import CucumberVisionError
from cucumbervision_greenhouse.language import counted, words_of
from cucumbervision_greenhouse.language import gettext as _

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from cucumbervision_greenhouse.store.waiting import Waiting


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


@dataclass(frozen=True)
class Progress:
    """The progress of a round.

    Parameters
    ----------
    waiting : int
        Captures of the round that are saved and not yet measured.
    measured : int
        Captures that were measured since the queue was last empty.
    aside : int
        Captures that failed three times; they are kept and not tried again.
    elsewhere : int
        Captures of other rounds that wait.
    fault : str
        Why no capture can be measured; empty if they can.
    title, done, total : str, int
        Other work on the round or on none, and its steps; a total of 0 is unknown.
    """

    waiting: int = 0
    measured: int = 0
    aside: int = 0
    elsewhere: int = 0
    fault: str = ""
    title: str = ""
    done: int = 0
    total: int = 0

    @property
    def words(self) -> str:
        """The current work, for people; empty if there is none.

        Examples
        --------
        >>> Progress(waiting=31, measured=12).words
        'Measuring: 12 of 43 captures'
        >>> Progress(waiting=1, elsewhere=3).words
        'Measuring: 0 of 1 capture; 3 of other rounds wait too'
        >>> Progress(title="Loading the networks").words, Progress(elsewhere=2).words
        ('Loading the networks …', 'Measuring 2 captures of other rounds')
        >>> Progress(waiting=2, fault="lost.json: is not there").words
        '2 captures wait to be measured: lost.json: is not there'
        """
        captures, total = "", self.waiting + self.measured
        if self.waiting and self.fault:
            return counted(
                self.waiting,
                "{n} capture waits to be measured: {fault}",
                "{n} captures wait to be measured: {fault}",
                fault=self.fault,
            )
        if self.waiting:
            captures = counted(
                total,
                "Measuring: {done} of {n} capture",
                "Measuring: {done} of {n} captures",
                done=self.measured,
            )
        if captures:
            elsewhere = ""
            if self.elsewhere:
                elsewhere = counted(
                    self.elsewhere, "{n} of other rounds waits too", "{n} of other rounds wait too"
                )
            return "; ".join(filter(None, (captures, elsewhere)))
        if self.title:
            words = _("{title}: {done} of {all}") if self.total else "{title} …"
            return words.format(title=_(self.title), done=self.done, all=self.total)
        if self.elsewhere:
            return counted(
                self.elsewhere,
                "Measuring {n} capture of other rounds",
                "Measuring {n} captures of other rounds",
            )
        return ""

    @property
    def first_words(self) -> str:
        """The text in place of the stops of an empty round; empty if no stop is to come.

        Examples
        --------
        >>> Progress(waiting=30).first_words
        '30 captures are saved, and none is measured yet. Their results appear here.'
        >>> Progress(aside=1).first_words
        '1 capture could not be measured; it is kept beside the store.'
        """
        if self.waiting:
            return counted(
                self.waiting,
                "{n} capture is saved, and not measured yet. Its results appear here.",
                "{n} captures are saved, and none is measured yet. Their results appear here.",
            )
        if self.aside:
            return counted(
                self.aside,
                "{n} capture could not be measured; it is kept beside the store.",
                "{n} captures could not be measured; they are kept beside the store.",
            )
        return ""

    @property
    def told(self) -> dict[str, Any]:
        """The progress for a browser: words, and the steps of the bar; a total of 0 is unknown."""
        steps = self.measured, self.waiting + self.measured
        if not self.waiting:
            steps = self.done, self.total
        return {"words": self.words, "done": steps[0], "total": steps[1], "waiting": self.waiting}


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
    stops = measured or {}
    queued = [capture.round_key == round_key for capture in captures if capture.key not in stops]
    job = next((candidate for candidate in jobs if candidate.round_key in ("", round_key)), None)
    return Progress(
        waiting=sum(queued),
        measured=list(stops.values()).count(round_key),
        aside=sum(capture.round_key == round_key for capture in aside),
        elsewhere=len(queued) - sum(queued),
        fault=fault,
        title=job.title if job else "",
        done=job.done if job else 0,
        total=job.total if job else 0,
    )
