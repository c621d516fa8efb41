"""Captures of a folder, shown one after the other instead of a camera."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.quality import depth_quality
from cucumbervision.capture.readers import CaptureRef, ReadOptions, open_source
from cucumbervision.errors import CaptureError, CucumberVisionError
from cucumbervision_greenhouse.backend.camera_feed import (
    HELD_S,
    CameraBurst,
    CameraFeed,
    Preview,
    picture_gone,
)

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision.capture.frames import Capture
    from cucumbervision_greenhouse.store.waiting import Waiting, WaitingCaptures


class ReplayBurst:
    """The capture that a replay shows at a press of the button."""

    nearest_s = 0.0  # a replay stands still

    def __init__(self, replay: Replay, capture: Capture | None, pressed_s: float) -> None:
        self._replay, self._capture, self.pressed_s = replay, capture, pressed_s

    @property
    def simulated(self) -> bool:
        """Whether the capture is computer-made."""
        return self.capture().simulated

    def keep(self, waiting: WaitingCaptures, key: str, round_key: str, stop: Stop) -> Waiting:
        """Keep the capture.

        Raises
        ------
        CaptureError
            If nothing of the replay can be read.
        StoreError
            If it cannot be kept.
        """
        capture = replace(self.capture(), stop=stop, timestamp_s=self.pressed_s)
        return waiting.put(capture, key, round_key, self.pressed_s)

    def capture(self) -> Capture:
        """Return the capture.

        Raises
        ------
        CaptureError
            If nothing of the replay can be read.
        """
        if self._capture is None:
            self._capture = self._replay.take(1, Stop())
        return self._capture


class Replay:
    """Captures of a folder or a recording instead of a camera; starts over at the end.

    Parameters
    ----------
    path : Path
        As `capture.readers.open_source` takes it.
    burst : int
        Frames fused to one capture, for recordings.
    """

    def __init__(self, path: Path, burst: int = 5) -> None:
        self._source = open_source(path, ReadOptions(burst=burst))
        self._refs: Iterator[CaptureRef] = iter(())
        self._changed = threading.Condition()
        self._newest = Preview("opening")
        self._is_loading = False  # one thread at a time, the only one that advances `_refs`
        self._begun_s = time.time()

    def preview(self) -> Preview:
        """Return the capture of the next press; a thread reads it."""
        with self._changed:
            self._load_next()
            return self._newest

    def take(self, burst: int, stop: Stop) -> Capture:  # noqa: ARG002, a replay's bursts are fused
        """Return the current capture, and load the next; each caller gets a different one.

        Raises
        ------
        CaptureError
            If nothing of the replay can be read.
        """
        with self._changed:
            self._load_next()
            self._changed.wait_for(lambda: self._newest.state != "opening")
            preview = self._newest
            if preview.capture is None:
                fault = preview.message or "nothing to replay"
                raise CaptureError(fault, remedy="choose another replay")
            self._move_on()
        return replace(preview.capture, stop=stop)

    def grab(self, burst: int, pressed_s: float) -> ReplayBurst:  # noqa: ARG002, as a camera's
        """Take the current capture, and load the next.

        Raises
        ------
        PictureGoneError
            If the moment lies before the replay began, or longer ago than a camera holds frames.
        """
        if pressed_s < max(self._begun_s, time.time() - HELD_S):
            raise picture_gone()
        with self._changed:
            capture = self._newest.capture if self._newest.state == "replay" else None
            if capture is not None:
                self._move_on()
        return ReplayBurst(self, capture, pressed_s)

    def _move_on(self) -> None:
        self._newest = replace(self._newest, state="opening", quality=None)
        self._load_next()

    def _load_next(self) -> None:
        """Start to load if nothing is shown and no thread loads."""
        if self._newest.state == "opening" and not self._is_loading:
            self._is_loading = True
            threading.Thread(target=self._load, name="replay", daemon=True).start()

    def _load(self) -> None:
        number = self._newest.number + 1
        try:
            preview = replace(self._read(), number=number)
        except Exception as error:  # the page shows it instead of the picture
            preview = Preview("absent", number=number, message=f"{self._source.path}: {error}")
        with self._changed:
            self._newest, self._is_loading = preview, False
            self._changed.notify_all()

    def _read(self) -> Preview:
        fault = "holds no captures"
        for _ in range(2):  # at the end start over once
            for ref in self._refs:
                try:
                    capture = ref.load()
                except CucumberVisionError as error:
                    fault = str(error)
                    continue
                return Preview("replay", capture, depth_quality(capture))
            self._refs = iter(self._source)
        return Preview("absent", message=f"{self._source.path}: {fault}")


Burst: TypeAlias = CameraBurst | ReplayBurst
"""What a press of the button takes."""

Feed: TypeAlias = CameraFeed | Replay
"""A source of frames to show and of captures to measure."""
