"""What all pages and viewers share: the store, the worker, the camera, the settings, the caches."""

from __future__ import annotations

import atexit
import os
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import streamlit as st
from streamlit.runtime.scriptrunner import get_script_run_ctx

from cucumbervision.agronomy.profiles import CropProfile, load_profile
from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.readers import RECORDING_SUFFIXES, open_source
from cucumbervision.capture.realsense import CameraConfig
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CucumberVisionError, StoreError
from cucumbervision.names import house_key
from cucumbervision.perception.registry import Registry, load_registry
from cucumbervision_greenhouse.agronomy.forecast import Forecast
from cucumbervision_greenhouse.backend.access import VIEWER, device_of
from cucumbervision_greenhouse.backend.camera_feed import PREVIEW_FPS, CameraFeed
from cucumbervision_greenhouse.backend.fruit_pictures import as_data_url, crop, drawn_on, joint_tube
from cucumbervision_greenhouse.backend.jobs import Job, Worker
from cucumbervision_greenhouse.backend.measuring import SharedMeasurer, measure_waiting
from cucumbervision_greenhouse.backend.progress import Progress, progress_of
from cucumbervision_greenhouse.backend.replay_feed import Feed, Replay
from cucumbervision_greenhouse.backend.round_tables import GradedRound, grade_round
from cucumbervision_greenhouse.backend.settings import (
    IMAGES_VARIABLE,
    REPLAY_VARIABLE,
    STORE_VARIABLE,
    Settings,
    default_store,
    read_settings,
    settings_file,
    write_settings,
)
from cucumbervision_greenhouse.backend.uploading import measure_upload
from cucumbervision_greenhouse.backend.uploads import Uploads
from cucumbervision_greenhouse.rounds.adding import (
    DEMONSTRATION,
    add_captures,
    is_demonstration,
    round_for_capture,
)
from cucumbervision_greenhouse.rounds.data_doubts import round_doubts
from cucumbervision_greenhouse.rounds.forecasting import (
    Today,
    forecast_today,
    midnight_s,
    read_today,
)
from cucumbervision_greenhouse.rounds.from_store import RoundContent, read_round
from cucumbervision_greenhouse.rounds.fruit_table import RoundFruit, fruit_table
from cucumbervision_greenhouse.rounds.joint_lengths import measure_jointly
from cucumbervision_greenhouse.rounds.merge_and_link import RowReport, row_reports, settle
from cucumbervision_greenhouse.rounds.merge_and_link import undo as undo_in
from cucumbervision_greenhouse.store.records import JointRecord, MethodRecord
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.views import (
    ActionView,
    DetectionDetail,
    DetectionView,
    RoundView,
)
from cucumbervision_greenhouse.store.waiting import WaitingCaptures, waiting_folder

_CUT_PX, _CUT_SHARE = 320, 0.8
KEPT = 8  # rounds, forecasts or fruit that are held at once
LINES = 20  # fruit on one page of the list


def where() -> str:
    """Return the path or URL of the store."""
    return os.environ.get(STORE_VARIABLE) or default_store()


def store() -> Store:
    """Return the store that all viewers work on, signed by the one who looks at this page."""
    return _store().signed(*_who())


def _who() -> tuple[str, str]:
    """Return whom the proxy logged in, else 'dashboard', and from which device."""
    if get_script_run_ctx(suppress_warning=True) is None:  # a job of the worker
        return "dashboard", ""
    return st.context.headers.get(VIEWER) or "dashboard", device_of(st.context.cookies)


@st.cache_resource(show_spinner=False)
def _store() -> Store:
    place, images = where(), os.environ.get(IMAGES_VARIABLE)
    if "://" not in place:
        Path(place).parent.mkdir(parents=True, exist_ok=True)
    return open_store(place, images=Path(images) if images else None)


@st.cache_resource(show_spinner=False)
def registry() -> Registry:
    """Return the registry of networks."""
    return load_registry()


@st.cache_resource(show_spinner=False)
def worker() -> Worker:
    """Return the one worker of this machine."""
    return Worker()


@st.cache_resource(show_spinner=False)
def measurer() -> SharedMeasurer:
    """Return the measurer, its networks loaded once."""
    return SharedMeasurer(registry())


@st.cache_resource(show_spinner=False)
def camera() -> CameraFeed:
    """Return the camera, opened when somebody views it."""
    return _feed_of("camera", CameraConfig(fps=PREVIEW_FPS, settings=settings().camera))


def _feed_of(name: str, config: CameraConfig, *, paced: bool = False) -> CameraFeed:
    folder = waiting_folder(where()).with_suffix(".frames") / name
    feed = CameraFeed(folder, config, paced=paced)
    # At once, where nobody kills this program: whatever comes next may need the camera.
    atexit.register(feed.end)
    return feed


@st.cache_resource(show_spinner=False)
def _replay(burst: int) -> Feed:
    chosen = Path(os.environ.get(REPLAY_VARIABLE) or example_captures())
    if chosen.suffix.lower() in RECORDING_SUFFIXES:
        # As a camera would send it, so that a walk can be tried.
        playing = CameraConfig(playback=chosen, warm_up=0, fps=PREVIEW_FPS)
        return _feed_of("replay", playing, paced=True)
    return Replay(chosen, burst)


@st.cache_resource(show_spinner=False)
def waiting() -> WaitingCaptures:
    """Return the captures that wait to be measured."""
    return WaitingCaptures(waiting_folder(where()))


@st.cache_resource(show_spinner=False)
def _measuring() -> list[Job]:
    return []


def wake() -> Job | None:
    """Start measuring what waits; return the job that does so, None where nothing waits."""
    jobs = _measuring()
    if jobs and not jobs[0].finished:
        return jobs[0]
    if not waiting().captures():
        return jobs[0] if jobs else None
    parts = waiting(), measurer(), store(), settings().options, _settle
    # With these it is no page's function any more, and may run when no page is open.
    jobs[:] = [worker().submit("Measuring", partial(measure_waiting, *parts), None)]
    return jobs[0]


def measuring_fault() -> str:
    """Return why what waits cannot be measured: a network or the calibration; empty if it can."""
    jobs = _measuring()
    return jobs[0].error if jobs else ""


@st.cache_resource(show_spinner=False)
def uploads() -> Uploads:
    """Return what was uploaded."""
    return Uploads(waiting_folder(where()).with_suffix(".uploads"))


@st.cache_resource(show_spinner=False)
def _uploading() -> set[str]:
    return set()


def measure_uploads() -> None:
    """Start measuring the uploads that are there and not measured; each once."""
    for key in uploads().to_measure():
        if key not in _uploading():
            _uploading().add(key)
            worker().submit("Measuring", partial(_measure_upload, key), None)


def _measure_upload(key: str, _: Job) -> None:
    try:
        measure_upload(uploads(), key, measurer(), store(), settings().options)
    finally:
        _uploading().discard(key)
    for round_key in {one.sending.round for one in uploads().all() if one.sending.key == key}:
        merge(round_key)


def _settle(round_key: str) -> str:
    one = next((x for x in store().rounds() if x.key == round_key), None)
    fault = settle(store(), round_key, profile_of(one)[1] if one else None)
    _mergings()[round_key] += 1
    work = partial(_measure_all_views, round_key)
    worker().submit("Measuring fruit by all their views", work, round_key)
    return fault


def _measure_all_views(round_key: str, job: Job) -> None:
    def report(done: int, total: int) -> None:
        job.done, job.total = done, total

    # A capture that comes meanwhile is measured first; merged with it, the round goes on here.
    done = measure_jointly(store(), round_key, report, lambda: bool(waiting().captures()))
    job.notes += (failure.message for failure in done.failures)
    if done.fruit:
        _mergings()[round_key] += 1


def replay_named() -> bool:
    """Return whether the command named a replay: it is then shown first."""
    return bool(os.environ.get(REPLAY_VARIABLE))


def feed(kind: str) -> Feed:
    """Return the camera, or for 'replay' the replay.

    Raises
    ------
    CaptureError
        If the replay cannot be read.
    """
    return _replay(settings().burst) if kind == "replay" else camera()


@st.cache_resource(show_spinner=False)
def _settings() -> list[Settings]:
    return [read_settings(settings_file(where()))]


def settings() -> Settings:
    """Return the settings, the same for all viewers."""
    return _settings()[0]


def change_settings(**changes: object) -> None:
    """Change some settings and write them, unless they are so already."""
    chosen = Settings.model_validate({**settings().model_dump(), **changes})
    if chosen != settings():
        _settings()[0] = chosen
        write_settings(chosen, settings_file(where()))


@st.cache_resource(show_spinner=False, max_entries=KEPT)
def _profile(name: str) -> tuple[str, CropProfile]:
    try:
        return name, load_profile(name)
    except CucumberVisionError:
        return "long-cucumber", load_profile("long-cucumber")


def profile_of(one: RoundView) -> tuple[str, CropProfile]:
    """Return name and crop profile of a round; the settings' where it names none that is here."""
    return _profile(one.record.profile or settings().profile)


@st.cache_resource(show_spinner=False)
def _mergings() -> Counter[str]:
    return Counter()


def merge(round_key: str) -> None:
    """Find the views of a round that are one fruit, beside the pages."""

    def work(job: Job) -> None:
        job.notes += filter(None, [_settle(round_key)])

    worker().submit("Merging views of the same fruit", work, round_key)


def undo(of: Store, round_key: str, *, number: int | None = None) -> ActionView:
    """Take back the last thing that the viewer did in a round, and only that; return it.

    A round one of whose stops was moved is merged anew.

    Parameters
    ----------
    of : Store
        Signed by the viewer.
    round_key : str
        The round.
    number : int, optional
        Of that action in the log instead.

    Raises
    ------
    StoreError
        If there is nothing to undo, or a later action depends on it.
    """
    actions = of.own_actions(round_key)
    action = next((x for x in actions if number in (None, x.number)), None)
    if action is None:
        raise StoreError("nothing to undo", remedy="see the log")
    moved = undo_in(of, number=action.number)
    if moved:
        merge(moved)
    return action


def rounds() -> list[RoundView]:
    """Return the rounds, the one walked last first, and the demonstration last of all.

    That is nobody's work.
    """
    return sorted(store().rounds(), key=lambda one: (is_demonstration(one.key), -one.walked_s))


def houses() -> list[str]:
    """Return the known houses, each by the name that it was given first."""
    named = sorted(store().rounds(), key=lambda one: one.record.started_s)
    found: dict[str, str] = {}
    for one in named:
        if one.record.house:
            found.setdefault(house_key(one.record.house), one.record.house)
    return sorted(found.values())


def news(round_key: str) -> dict[str, Any]:
    """Return what open pages must know at once: what waits, what is done, and the round's version.

    Parameters
    ----------
    round_key : str
        The round that is looked at; its `version` changes whenever a page of it would.
    """
    one = next((x for x in store().rounds() if x.key == round_key), None)
    counts = worker().finished + uploads().changes, 0 if one is None else hash(_version(one))
    return {
        "version": f"{counts[0]}-{counts[1]}",
        "now_s": time.time(),
        "work": progress(round_key).told,
    }


def progress(round_key: str) -> Progress:
    """Return what waits and is measured of a round, for every page alike."""
    going_on = [uploads().read(key) for key in sorted(_uploading())]
    measured = next((job.measured for job in _measuring() if not job.finished), None)
    there = [one for one in going_on if one is not None and not one.done]
    queue = waiting().captures(), waiting().set_aside()
    jobs = worker().unfinished()
    return progress_of(round_key, *queue, there, measured, jobs, measuring_fault())


def _version(one: RoundView) -> tuple[object, ...]:
    """Return what changes whenever a page of the round would."""
    return (*_measured_version(one), store().newest_action(one.key))


def _measured_version(one: RoundView) -> tuple[object, ...]:
    counts = one.stops, one.fruit, one.last_s
    return (one.key, *counts, _mergings()[one.key], profile_of(one)[0])


_OF_ROUND: dict[str | type[Any], Callable[[Any], Any]] = {RoundView: _version}
_OF_FRUIT: dict[str | type[Any], Callable[[Any], Any]] = {
    DetectionView: lambda view: (view.key, view.corrected, view.record.box_x1_px),
    JointRecord: lambda joint: joint.key,
}


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600, hash_funcs=_OF_ROUND)
def content_of(one: RoundView) -> RoundContent:
    """Return what the store holds of a round; read again only when something changed."""
    return read_round(store(), one.key)


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=120, hash_funcs=_OF_ROUND)
def graded_round(one: RoundView) -> GradedRound:
    """Return a round's fruit and grades; read again only when something changed."""
    return grade_round(content_of(one), fruit_of(one), profile_of(one)[1])


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=120, hash_funcs=_OF_ROUND)
def methods_of(one: RoundView) -> dict[str, tuple[MethodRecord, ...]]:
    """Return every method's length by the fruit's keys, for what few look at."""
    return store().measurements(one.key)


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600, hash_funcs=_OF_ROUND)
def rows_of(one: RoundView) -> list[RowReport]:
    """Return a round's rows with their counts; read again only when something changed."""
    return row_reports(content_of(one))


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600, hash_funcs=_OF_ROUND)
def doubts_of(one: RoundView) -> list[str]:
    """Return what the data of a round makes doubtful, once for all of it, each with the remedy."""
    return round_doubts(store(), content_of(one).views)


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600, hash_funcs=_OF_ROUND)
def fruit_of(one: RoundView) -> list[RoundFruit]:
    """Return a round's fruit with the lengths by all their views; read again when that changed."""
    return fruit_table(content_of(one))


@st.cache_resource(show_spinner="Forecasting …", max_entries=KEPT, ttl=600, hash_funcs=_OF_ROUND)
def forecast_of(one: RoundView) -> Forecast:
    """Return a round's forecast from today on; computed again only when something changed."""
    return forecast_today(store(), one, profile_of(one)[1], time.time(), content_of(one))


def _unpicked_version(one: RoundView) -> tuple[object, ...]:
    """Return what changes whenever a round's list of picks would, but for what is picked of it."""
    newest = store().newest_action(one.key, without=("pick", "unpick"))
    return (*_measured_version(one), newest, midnight_s(time.time()))


@st.cache_resource(
    show_spinner="Forecasting …",
    max_entries=KEPT,
    ttl=3600,
    hash_funcs={RoundView: _unpicked_version},
)
def today_of(one: RoundView) -> Today:
    """Return what a round says of today; fruit that are picked today stay in it."""
    return read_today(store(), one, profile_of(one)[1], time.time(), content_of(one))


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=120, hash_funcs=_OF_ROUND)
def fruit_detail(one: RoundView, fruit_key: str) -> DetectionDetail:  # noqa: ARG001, its version
    """Return one fruit with everything."""
    return store().detection(fruit_key)


@st.cache_resource(show_spinner=False, max_entries=2000)
def _capture_widths(stop_key: str) -> dict[str, int]:
    return {one.name: one.width_px for one in store().stop(stop_key).captures}


@st.cache_resource(show_spinner=False, max_entries=400, hash_funcs=_OF_FRUIT)
def thumbnail_of(view: DetectionView) -> str | None:
    """Return a fruit's thumbnail as a data URL; None where none was kept."""
    if view.thumbnail is None:
        return None
    small = store().images.read_color(view.thumbnail)
    return as_data_url(crop(small, view.record, _capture_widths(view.stop_key)[view.capture]))


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600)
def joint_of(round_key: str, key: str) -> JointRecord:
    """Return the tube in all views of a fruit, with its path and the cameras' poses."""
    return store().joint_drawing(round_key, key)


@st.cache_resource(show_spinner=False, max_entries=400, hash_funcs=_OF_FRUIT)
def cutout_of(view: DetectionView, joint: JointRecord | None = None) -> str | None:
    """Return a fruit cut out of its picture as a data URL; None where none was kept.

    `joint` is drawn on it where it was fitted to this view.
    """
    captures = {one.name: one for one in store().stop(view.stop_key).captures}
    taken = captures[view.capture]
    if taken.color is None:
        return None
    color = store().images.read_color(taken.color)
    tube = None if joint is None else joint_tube(joint, view.key)
    if tube is not None:
        camera = CameraModel.model_validate(dict(taken.camera)).intrinsics
        color = drawn_on(color, tube, camera)
    return as_data_url(crop(color, view.record, taken.width_px, _CUT_PX, _CUT_SHARE))


@st.cache_resource(show_spinner=False)
def prepare() -> Job | None:
    """Load the networks before the first capture; measure the bundled ones into an empty store."""
    waiting().clean()
    measure_uploads()
    if wake() is not None:
        return None
    if store().rounds() or store().rounds(deleted=True):
        return worker().submit("Loading the networks", _warm_up)
    round_for_capture(store(), "", simulated=True, profile=settings().profile)
    return worker().submit("Measuring the bundled captures", _demonstrate, DEMONSTRATION)


def read_ahead() -> None:
    """Read the newest round, so that the first page that is opened need not wait for it."""
    for one in rounds()[:1]:
        for view in graded_round(one).fruit[:LINES]:
            thumbnail_of(view)
        rows_of(one)
        forecast_of(one)
        today_of(one)


def _demonstrate(job: Job) -> None:
    options = settings().options
    places = [example_captures()]
    job.total = open_source(places[0]).total or 0
    done = add_captures(store(), DEMONSTRATION, places, options, report=lambda _: job.step())
    job.notes += (one.failure.message for one in done if one.failure is not None)
    merge(DEMONSTRATION)
    worker().submit("Loading the networks", _warm_up)


def _warm_up(_: Job) -> None:
    measurer().warm_up(settings().options)
