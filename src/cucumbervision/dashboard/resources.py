"""What all pages and viewers share: the store, the worker, the camera, the settings."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.agronomy.profiles import load_profile
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.dashboard.camera_feed import CameraFeed, Feed, Replay
from cucumbervision.dashboard.jobs import Job, Worker
from cucumbervision.dashboard.measuring import SharedMeasurer
from cucumbervision.dashboard.round_tables import RoundLists, read_lists, round_version
from cucumbervision.dashboard.server import (
    IMAGES_VARIABLE,
    REPLAY_VARIABLE,
    STORE_VARIABLE,
    default_store,
)
from cucumbervision.dashboard.settings import (
    Settings,
    read_settings,
    settings_file,
    write_settings,
)
from cucumbervision.errors import CucumberVisionError
from cucumbervision.perception.registry import Registry, load_registry
from cucumbervision.rounds.forecasting import forecast_for
from cucumbervision.rounds.service import merge_round
from cucumbervision.store.records import RoundRecord, key_of
from cucumbervision.store.repository import Store, open_store

if TYPE_CHECKING:
    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.store.views import DetectionDetail, RoundView

__all__ = [
    "camera",
    "capture_widths",
    "feed",
    "forecast_of",
    "fruit_detail",
    "lists_of",
    "measurer",
    "merge",
    "options",
    "prepare",
    "profile",
    "registry",
    "replay_named",
    "replay_path",
    "save_settings",
    "settings",
    "store",
    "thumbnail",
    "where",
    "worker",
]

DEMONSTRATION = "Demonstration (simulated captures)"
KEPT = 8  # rounds, forecasts or fruit that are held at once


def where() -> str:
    """Give where the store is."""
    return os.environ.get(STORE_VARIABLE) or default_store()


@st.cache_resource(show_spinner="Opening the store …")
def _store(place: str, images: str) -> Store:
    if "://" not in place:
        Path(place).parent.mkdir(parents=True, exist_ok=True)
    return open_store(place, images=Path(images) if images else None)


def store() -> Store:
    """Give the store that all viewers work on."""
    return _store(where(), os.environ.get(IMAGES_VARIABLE, ""))


@st.cache_resource(show_spinner=False)
def registry() -> Registry:
    """Give the networks that have a name."""
    return load_registry()


@st.cache_resource(show_spinner=False)
def worker() -> Worker:
    """Give the one worker of this machine."""
    return Worker()


@st.cache_resource(show_spinner=False)
def measurer() -> SharedMeasurer:
    """Give what measures, its networks loaded once."""
    return SharedMeasurer(registry())


@st.cache_resource(show_spinner=False)
def camera() -> CameraFeed:
    """Give the camera, opened when somebody looks."""
    return CameraFeed()


@st.cache_resource(show_spinner=False)
def _replay(path: str, burst: int) -> Replay:
    return Replay(Path(path), burst)


def replay_named() -> bool:
    """Say whether the command named a replay: it is then shown first."""
    return bool(os.environ.get(REPLAY_VARIABLE))


def replay_path() -> Path:
    """Give what is replayed where no camera is: as the command says, or the bundled captures."""
    if chosen := os.environ.get(REPLAY_VARIABLE):
        return Path(chosen)
    from cucumbervision.capture.source import bundled_captures

    return bundled_captures()


def feed(kind: str) -> Feed:
    """Give the camera, or for 'replay' the replay.

    Raises
    ------
    CaptureError
        If the replay cannot be read.
    """
    return _replay(str(replay_path()), settings().burst) if kind == "replay" else camera()


@st.cache_resource(show_spinner=False)
def _kept_settings(path: str) -> dict[str, Settings]:
    return {"now": read_settings(Path(path))}


def settings() -> Settings:
    """Give the settings, the same for all viewers."""
    return _kept_settings(str(settings_file(where())))["now"]


def save_settings(chosen: Settings) -> None:
    """Keep settings from now on."""
    path = settings_file(where())
    _kept_settings(str(path))["now"] = chosen
    write_settings(chosen, path)


def options() -> MeasureOptions:
    """Give the options of the next measurement."""
    return settings().options


@st.cache_resource(show_spinner=False, max_entries=KEPT)
def _profile(name: str) -> CropProfile:
    return load_profile(name)


def profile(one: RoundView) -> CropProfile:
    """Give a round's crop profile; the settings' where it names none that is here."""
    return _profile(_named(one))


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=120)
def _lists(version: tuple[object, ...], named: str, place: str) -> RoundLists:
    del place
    return read_lists(store(), str(version[0]), _profile(named))


@st.cache_resource(show_spinner=False)
def _mergings() -> Counter[str]:
    return Counter()


def merge(round_key: str) -> None:
    """Find the views of a round that are one fruit, beside the pages."""

    def work(_: Job) -> None:
        merge_round(store(), round_key)
        _mergings()[round_key] += 1

    worker().submit("Merging views of the same fruit", work)


def _version(one: RoundView) -> tuple[object, ...]:
    return (*round_version(store(), one), _mergings()[one.key])


def _named(one: RoundView) -> str:
    named = one.record.profile or settings().profile
    try:
        _profile(named)
    except CucumberVisionError:
        return "long-cucumber"
    return named


def lists_of(one: RoundView) -> RoundLists:
    """Give a round's fruit and grades; read again only when something changed."""
    return _lists(_version(one), _named(one), where())


@st.cache_resource(show_spinner="Forecasting …", max_entries=KEPT, ttl=600)
def _forecast(version: tuple[object, ...], named: str, place: str) -> Forecast:
    del place
    return forecast_for(store(), str(version[0]), _profile(named))


def forecast_of(one: RoundView) -> Forecast:
    """Give a round's forecast; computed again only when something changed."""
    return _forecast(_version(one), _named(one), where())


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=120)
def _detail(fruit_key: str, version: tuple[object, ...], place: str) -> DetectionDetail:
    del version, place
    return store().detection(fruit_key)


def fruit_detail(one: RoundView, fruit_key: str) -> DetectionDetail:
    """Give one fruit with everything."""
    return _detail(fruit_key, _version(one), where())


@st.cache_data(show_spinner=False, max_entries=2000)
def capture_widths(stop_key: str) -> dict[str, int]:
    """Give how wide the captures of a stop are, pixels, by name."""
    return {one.name: one.width_px for one in store().stop(stop_key).captures}


@st.cache_data(show_spinner=False, max_entries=400)
def thumbnail(sha256: str, box: tuple[float, float, float, float], width_px: int) -> str:
    """Give a fruit's little picture as a data URL."""
    from cucumbervision.dashboard.fruit_view import as_data_url, crop
    from cucumbervision.store.records import DetectionRecord, ImageRef

    small = store().images.read_color(ImageRef(sha256, ".jpg", 0, 0, 0))
    x1, y1, x2, y2 = box
    record = DetectionRecord(1, box_x1_px=x1, box_y1_px=y1, box_x2_px=x2, box_y2_px=y2)
    return as_data_url(crop(small, record, width_px))


@st.cache_resource(show_spinner=False)
def _prepared(place: str) -> Job | None:
    del place
    if store().rounds():
        return worker().submit("Loading the networks", _warm)
    record = RoundRecord(key_of("demonstration"), DEMONSTRATION, profile=settings().profile)
    store().save_round(record)
    return worker().submit("Measuring the bundled captures", _demonstrate)


def prepare() -> Job | None:
    """Begin what makes the first capture quick; an empty store gets the bundled round."""
    return _prepared(where())


def _demonstrate(job: Job) -> None:
    from cucumbervision.capture.source import bundled_captures

    source = open_source(bundled_captures(), ReadOptions(burst=settings().burst))
    job.total = source.total or 0
    for ref in source:
        taken = measurer().take_stop(store(), key_of("demonstration"), ref.load(), options())
        job.step(taken.note)
    merge(key_of("demonstration"))


def _warm(_: Job) -> None:
    from cucumbervision.capture.source import bundled_captures

    first = next(iter(open_source(bundled_captures())))
    measurer().with_options(options()).measure(first.load())
