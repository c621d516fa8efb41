"""What all viewers share, opened once: the store, the job queue, captures, uploads, settings."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import streamlit as st

from cucumbervision.crop.profiles import CropProfile, load_profile, profiles
from cucumbervision.errors import CucumberVisionError
from cucumbervision.names import house_key
from cucumbervision.networks.registry import Registry, load_registry
from cucumbervision_greenhouse.access import VIEWER, device_of
from cucumbervision_greenhouse.jobs import JobQueue
from cucumbervision_greenhouse.language import (
    asked_language,
    best_of,
    decide_by,
    gettext,
    marked,
    sentence,
    told_apart,
)
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
            st.toast(sentence(error), icon=":material/error:", duration="long")


def _language() -> str:
    """Return the language of the settings, else the one of the viewer's browser."""
    # Without a page it is a request beside Streamlit's.
    return settings().language or asked_language() or best_of(st.context.locale)


decide_by(_language)


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
    return told_apart({name: gettext(title) for name, title in _crop_titles().items()})


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
    return sorted(
        store().rounds(),
        key=lambda round_summary: (is_demonstration(round_summary.key), -round_summary.walked_s),
    )


USUAL_NAME, USUAL_HOUSE = marked("Morning round"), marked("House 1")
"""What an empty field of a new round stands for, and shows."""


def new_round(name: str, house: str, profile: str = "", key: str = "") -> Round:
    """Return a round that is begun, by default with the crop of the settings."""
    name, house = name.strip() or gettext(USUAL_NAME), house.strip() or gettext(USUAL_HOUSE)
    return Round(key or new_key(), name, house, profile=profile or settings().profile)


def houses(of_rounds: Iterable[Round]) -> list[str]:
    """Return the houses of rounds, each by the first of its names."""
    named = sorted(of_rounds, key=lambda round_summary: round_summary.started_s)
    name_of_house: dict[str, str] = {}
    for round_summary in named:
        if round_summary.house:
            name_of_house.setdefault(house_key(round_summary.house), round_summary.house)
    return sorted(name_of_house.values())
