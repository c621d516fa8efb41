"""The camera, and the recording in its place; each is opened for its first viewer."""

from __future__ import annotations

import atexit
import os
from pathlib import Path

import streamlit as st

from cucumbervision.capture.readers import RECORDING_SUFFIXES
from cucumbervision.capture.realsense import CameraConfig
from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse.backend.camera_feed import PREVIEW_FPS, CameraFeed
from cucumbervision_greenhouse.backend.replay_feed import Feed, Replay
from cucumbervision_greenhouse.backend.resources import settings, where
from cucumbervision_greenhouse.backend.settings import REPLAY_VARIABLE
from cucumbervision_greenhouse.store.waiting import waiting_folder


@st.cache_resource(show_spinner=False)
def camera() -> CameraFeed:
    """Return the camera, which opens for its first viewer."""
    return _feed_of("camera", CameraConfig(fps=PREVIEW_FPS, settings=settings().camera))


def _feed_of(name: str, config: CameraConfig, *, paced: bool = False) -> CameraFeed:
    folder = waiting_folder(where()).with_suffix(".frames") / name
    feed = CameraFeed(folder, config, paced=paced)
    # Release it at once at a normal exit, since the next program may need the camera.
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


def replay_named() -> bool:
    """Return whether the command named a replay, which is then shown first."""
    return bool(os.environ.get(REPLAY_VARIABLE))


def feed(kind: str) -> Feed:
    """Return the camera, or for 'replay' the replay.

    Raises
    ------
    CaptureError
        If the replay cannot be read.
    """
    return _replay(settings().burst) if kind == "replay" else camera()
