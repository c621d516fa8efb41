"""Background work: measure queued captures and uploads, and merge views of one fruit."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass
from functools import partial

import streamlit as st

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import DiskFullError, StoreAwayError, StoreError, named_error
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.language import counted, marked
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.resources import Job, settings, store, uploads, waiting, worker
from cucumbervision_greenhouse.rounds import adding, merge_and_link
from cucumbervision_greenhouse.rounds.walking import DEMONSTRATION, round_for_capture
from cucumbervision_greenhouse.store.records import LogEntry
from cucumbervision_greenhouse.store.repository import Store


@st.cache_resource(show_spinner=False)
def _last() -> dict[str, Job]:
    """Return the last jobs that measured and read uploads, by what they did."""
    return {}


def wake() -> Job | None:
    """Start measuring the queued captures; return the job, or None if the queue is empty."""
    job = _last().get("measure")
    if (job and not job.finished) or not waiting().captures():
        return job
    job = _last()["measure"] = worker().submit(marked("Measuring"), measure_waiting, None)
    return job


def measure_waiting(job: Job) -> int:
    """Measure queued captures until the queue is empty; return how many became stops.

    A capture leaves the queue after its stop is in the store, so that it is never lost. Settings or
    a calibration that change meanwhile count from the next capture on. A round is merged after its
    last queued capture; what cannot be measured is logged.

    Parameters
    ----------
    job : Job
        Counts the captures of each round.

    Raises
    ------
    CucumberVisionError
        If nothing can be measured at all: a network or the calibration cannot be loaded, the disk
        is full, or the store is not there.
    """
    while queue := waiting().captures():
        measurer = resources.measurer().with_options(settings().options)
        measurer.load()  # if this fails, no capture is tried
        queued, *later = queue
        waiting().begin(queued)
        try:
            if store().stop_is_deleted(queued.key) is None:
                capture = queued.load()
                stop = adding.Place().stop(capture, queued.key, queued.round_key)
                adding.save_measured(store(), stop, measurer.attempt(capture), measurer)
        except Exception as error:
            fault = named_error(error, queued.key)
            if isinstance(fault, DiskFullError | StoreAwayError):
                waiting().forget_start(queued)  # no fault of the capture
                raise fault from error
            logging.getLogger(__name__).warning("not measured: %s", fault)
            continue
        job.measured[queued.key] = queued.round_key
        waiting().done(queued)
        if all(other.round_key != queued.round_key for other in later):
            _settle(queued.round_key)
    return len(job.measured)


def measuring_fault() -> str:
    """Return why queued captures cannot be measured (network, calibration); empty if they can."""
    job = _last().get("measure")
    return job.error if job else ""


def queue_uploads() -> None:
    """Let the captures of complete uploads wait to be measured."""
    title = marked("Reading the files that were sent")
    _last()["read"] = worker().submit(title, _queue_uploads)


def upload_fault() -> str:
    """Return why uploads cannot be read now, such as a full disk; empty if they can."""
    job = _last().get("read")
    return job.error if job else ""


def _queue_uploads(_: Job) -> None:
    for key in uploads().whole():
        uploads().queue(key, waiting(), store(), settings().options.reading)
        wake()


def _settle(round_key: str, _: Job | None = None) -> None:
    walk = store().round(round_key)
    profile = resources.profile_of(walk)[1] if walk else None
    fault = merge_and_link.settle(store(), round_key, profile)
    mergings()[round_key] += 1
    if fault:
        logging.getLogger(__name__).warning("round %s: %s", round_key, fault)


@st.cache_resource(show_spinner=False)
def mergings() -> Counter[str]:
    """Return how often the views of each round were merged, by the rounds' keys."""
    return Counter()


def merge(round_key: str) -> None:
    """Merge the views of a round in the background."""
    work = partial(_settle, round_key)
    worker().submit(marked("Merging views of the same fruit"), work, round_key)


def undo(store: Store, round_key: str, *, number: int | None = None) -> LogEntry:
    """Undo the viewer's last action in a round, and return it.

    Rounds whose stop or house has changed are merged again.

    Parameters
    ----------
    store : Store
        Signed by the viewer.
    round_key : str
        The round.
    number : int, optional
        Number of another action in the log, to undo instead.

    Raises
    ------
    StoreError
        If there is nothing to undo, or a later action depends on it.
    """
    actions = store.own_actions(round_key)
    action = next((x for x in actions if number in (None, x.number)), None)
    if action is None:
        raise StoreError("nothing to undo", remedy="see the log")
    for changed in merge_and_link.undo(store, number=action.number):
        merge(changed)
    return action


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


def progress(round_key: str) -> Progress:
    """Return the work on a round, the same for every page."""
    job, fault, first, words = _last().get("measure"), measuring_fault(), "", ""
    measured = job.measured if job and not job.finished else {}
    queued = [x.round_key for x in waiting().captures() if x.key not in measured]
    due = queued.count(round_key)
    done, elsewhere = (list(measured.values()).count(round_key) if due else 0, len(queued) - due)
    task = next((x for x in worker().unfinished() if x.round_key in ("", round_key)), None)
    if due:
        first = counted(
            due,
            "{n} capture is saved, and not measured yet. Its results appear here.",
            "{n} captures are saved, and none is measured yet. Their results appear here.",
        )
        words = counted(
            due + done,
            "Measuring: {done} of {n} capture",
            "Measuring: {done} of {n} captures",
            done=done,
        )
    elif failed := sum(x.round_key == round_key for x in waiting().set_aside()):
        first = counted(
            failed,
            "{n} capture could not be measured; it is kept beside the store.",
            "{n} captures could not be measured; they are kept beside the store.",
        )
    if due and fault:
        words = counted(
            due,
            "{n} capture waits to be measured: {fault}",
            "{n} captures wait to be measured: {fault}",
            fault=fault,
        )
    elif task is not None and not due:
        words = _("{title}: {done} of {all}") if task.total else "{title} …"
        words = words.format(title=_(task.title), done=task.done, all=task.total)
        return Progress(words, first, task.done, task.total)
    if elsewhere:
        others = counted(
            elsewhere, "{n} capture of other rounds waits", "{n} captures of other rounds wait"
        )
        words = "; ".join(filter(None, (words, others)))
    return Progress(words, first, done, due + done, due)


@st.cache_resource(show_spinner=False)
def prepare() -> Job | None:
    """Measure what waits, and the bundled captures into an empty store."""
    waiting().clean()
    if uploads().whole():
        queue_uploads()
    if wake() is not None or store().rounds() or store().rounds(deleted=True):
        return None
    round_for_capture(store(), "", simulated=True, profile=settings().profile)
    return worker().submit(marked("Measuring the bundled captures"), _demonstrate, DEMONSTRATION)


def _demonstrate(job: Job) -> None:
    places = [example_captures()]
    job.total = open_source(places[0]).total or 0

    def step(_: object) -> None:
        job.done += 1

    adding.add_captures(store(), DEMONSTRATION, places, settings().options, report=step)
    merge(DEMONSTRATION)


def warm_up() -> Job:
    """Load the networks before the first capture; no page waits for it."""
    work = partial(resources.measurer().warm_up, settings().options)
    return worker().submit(marked("Loading the networks"), lambda _: work(), None)
