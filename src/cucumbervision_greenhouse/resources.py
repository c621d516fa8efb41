"""What all viewers share, opened once: the store, jobs, captures, uploads, settings."""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import streamlit as st
from starlette.requests import Request

from cucumbervision.crop.profiles import CropProfile, load_profile, profiles
from cucumbervision.errors import CucumberVisionError
from cucumbervision.names import house_key
from cucumbervision.networks.registry import Registry, load_registry
from cucumbervision_greenhouse import language
from cucumbervision_greenhouse.access import VIEWER, device_of
from cucumbervision_greenhouse.language import gettext, marked
from cucumbervision_greenhouse.measuring import SharedMeasurer
from cucumbervision_greenhouse.rounds.walking import is_demonstration
from cucumbervision_greenhouse.settings import (
    STORE_VARIABLE,
    Settings,
    default_store,
    read_settings,
    settings_file,
    write_settings,
)
from cucumbervision_greenhouse.store.records import Round, new_key
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures, waiting_folder
from cucumbervision_greenhouse.uploads import Uploads

KEPT = 8  # largest number of cached rounds, forecasts or fruit


def fault_of(future: Future[Any]) -> str:
    """Return why work failed, for people; empty while it runs or if it succeeded."""
    error = future.exception() if future.done() else None
    if error is None or isinstance(error, CucumberVisionError):
        return language.words_of(error or "")
    return f"{type(error).__name__}: {error}"


@dataclass(eq=False)
class Job:
    """One piece of work and its progress.

    Parameters
    ----------
    title : str
        What it is, for people.
    round_key : str, optional
        The round that it works on; empty for none, None for captures of any.
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


def where() -> str:
    """Return the whole path, or the URL, of the store."""
    return _whole(os.environ.get(STORE_VARIABLE) or default_store())


@lru_cache(maxsize=1)
def _whole(place: str) -> str:
    # Settings keep the paths of files beside it, for a dashboard that is started elsewhere.
    return place if "://" in place else str(Path(place).absolute())


def store() -> Store:
    """Return the store of all viewers, signed by the viewer of this page."""
    name = st.context.headers.get(VIEWER) or "dashboard"  # whom the proxy logged in
    return _store().signed(name, device_of(st.context.cookies))


def store_of(request: Request) -> Store:
    """Return the store, signed by the sender of a request."""
    name = request.scope.get("viewer") or "dashboard"
    return _store().signed(name, device_of(request.cookies))


@st.cache_resource(show_spinner=False)
def _store() -> Store:
    place = where()
    if "://" not in place:
        Path(place).parent.mkdir(parents=True, exist_ok=True)
    return open_store(place)


@st.cache_resource(show_spinner=False)
def registry() -> Registry:
    """Return the registry of networks."""
    return load_registry()


@st.cache_resource(show_spinner=False)
def worker() -> JobQueue:
    """Return the job queue of this machine."""
    return JobQueue()


@st.cache_resource(show_spinner=False)
def measurer() -> SharedMeasurer:
    """Return the measurer, its networks loaded once."""
    return SharedMeasurer(registry())


@st.cache_resource(show_spinner=False)
def waiting() -> WaitingCaptures:
    """Return the captures that wait to be measured."""
    return WaitingCaptures(waiting_folder(where()))


@st.cache_resource(show_spinner=False)
def uploads() -> Uploads:
    """Return the uploads."""
    return Uploads(waiting_folder(where()).with_suffix(".uploads"))


@lru_cache(maxsize=1)
def _settings(place: str) -> list[Settings]:
    # Every text of a page asks for the language; Streamlit's cache would take longer than the text.
    return [read_settings(settings_file(place))]


def settings() -> Settings:
    """Return the settings, the same for all viewers."""
    return _settings(where())[0]


_CHANGING = threading.Lock()


def change_settings(**changes: object) -> None:
    """Change some settings, and write them if they differ.

    Those that cannot be written count until the dashboard ends, and the page says so.
    """
    with _CHANGING:  # two viewers change two settings
        chosen = Settings.model_validate({**settings().model_dump(), **changes})
        if chosen == settings():
            return
        _settings(where())[0] = chosen
        try:
            write_settings(chosen, settings_file(where()))
        except CucumberVisionError as error:
            st.toast(language.sentence(error), icon=":material/error:", duration="long")


def _language() -> str:
    """Return the language of the settings, else the one of the viewer's browser."""
    # Without a page it is a request beside Streamlit's.
    return settings().language or language.asked_language() or language.best_of(st.context.locale)


language.decide_by(_language)


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=60)
def _profile(name: str) -> tuple[str, CropProfile]:
    try:
        return name, load_profile(name)
    except CucumberVisionError:
        return "long-cucumber", load_profile("long-cucumber")


@st.cache_resource(show_spinner=False, ttl=60)
def _crop_titles() -> dict[str, str]:
    readable = {entry.name: entry.profile for entry in profiles()}
    return {name: profile.title for name, profile in readable.items() if profile is not None}


def crop_titles() -> dict[str, str]:
    """Return the titles of all readable crop profiles by their names, each title once."""
    return language.told_apart({name: gettext(title) for name, title in _crop_titles().items()})


def forget_profiles() -> None:
    """Read crop profiles again, since a file was changed."""
    _profile.clear()
    _crop_titles.clear()


def profile_of(round_summary: Round) -> tuple[str, CropProfile]:
    """Return name and crop profile of a round; those of the settings if its own is unknown."""
    return _profile(round_summary.profile or settings().profile)


def rounds() -> list[Round]:
    """Return the rounds, the latest walk first, and the demonstration last.

    That is nobody's work.
    """
    return sorted(store().rounds(), key=lambda walk: (is_demonstration(walk.key), -walk.walked_s))


USUAL_NAME, USUAL_HOUSE = marked("Morning round"), marked("House 1")
"""What an empty field of a new round stands for, and shows."""


def new_round(name: str, house: str, profile: str = "", key: str = "") -> Round:
    """Return a round that is begun, by default with the crop of the settings."""
    name, house = name.strip() or gettext(USUAL_NAME), house.strip() or gettext(USUAL_HOUSE)
    return Round(key or new_key(), name, house, profile=profile or settings().profile)


def houses(of_rounds: Iterable[Round]) -> list[str]:
    """Return the houses of rounds, each by the first of its names."""
    newest_first = sorted(of_rounds, key=lambda walk: -walk.started_s)
    return sorted({house_key(x.house): x.house for x in newest_first if x.house}.values())
