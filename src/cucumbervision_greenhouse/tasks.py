"""Background work: measure queued captures and uploads, and merge views of one fruit."""

from __future__ import annotations

import logging
from collections import Counter
from functools import partial

import streamlit as st

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import StoreError
from cucumbervision_greenhouse.jobs import Job, Progress, progress_of
from cucumbervision_greenhouse.language import marked
from cucumbervision_greenhouse.measuring import measure_waiting
from cucumbervision_greenhouse.resources import (
    measurer,
    profile_of,
    settings,
    store,
    uploads,
    waiting,
    worker,
)
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.rounds.merge_and_link import settle
from cucumbervision_greenhouse.rounds.merge_and_link import undo as undo_in
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
    parts = waiting(), measurer(), store(), lambda: settings().options, _settle
    # A partial function is not bound to a page, so that it may run with no page open.
    job = worker().submit(marked("Measuring"), partial(measure_waiting, *parts), None)
    _last()["measure"] = job
    return job


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
    round_summary = store().round(round_key)
    fault = settle(store(), round_key, profile_of(round_summary)[1] if round_summary else None)
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
    for changed in undo_in(store, number=action.number):
        merge(changed)
    return action


def progress(round_key: str) -> Progress:
    """Return the progress of a round, the same for every page."""
    job = _last().get("measure")
    measured = job.measured if job and not job.finished else None
    queue = waiting().captures(), waiting().set_aside()
    return progress_of(round_key, *queue, measured, worker().unfinished(), measuring_fault())


@st.cache_resource(show_spinner=False)
def prepare() -> Job | None:
    """Measure what waits, and the bundled captures into an empty store."""
    waiting().clean()
    if uploads().whole():
        queue_uploads()
    if wake() is not None:
        return None
    if store().rounds() or store().rounds(deleted=True):
        return None
    round_for_capture(store(), "", simulated=True, profile=settings().profile)
    return worker().submit(marked("Measuring the bundled captures"), _demonstrate, DEMONSTRATION)


def _demonstrate(job: Job) -> None:
    places = [example_captures()]
    job.total = open_source(places[0]).total or 0

    def step(_: object) -> None:
        job.done += 1

    add_captures(store(), DEMONSTRATION, places, settings().options, report=step)
    merge(DEMONSTRATION)


def warm_up() -> Job:
    """Load the networks before the first capture; no page waits for it."""
    work = partial(measurer().warm_up, settings().options)
    return worker().submit(marked("Loading the networks"), lambda _: work(), None)
