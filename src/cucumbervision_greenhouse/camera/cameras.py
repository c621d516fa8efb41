"""The camera, or a recording or folder in its place: its newest frame, and bursts at a press.

One thread reads frames while somebody looks, into a ring of the last `HELD_S`, so that a press that
arrives late gets the picture of its moment.
"""

from __future__ import annotations

import atexit
import math
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import streamlit as st
from numpy.typing import NDArray

from cucumbervision.capture.camera import DepthQuality, depth_quality
from cucumbervision.capture.frames import Capture, fuse_burst, moved_px
from cucumbervision.capture.readers import RECORDING_SUFFIXES, CaptureRef, ReadOptions, open_source
from cucumbervision.capture.realsense import CameraConfig, CameraSettings, RealSenseCamera
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CameraError, CucumberVisionError, DepthError, Message, with_reason
from cucumbervision_greenhouse.resources import settings, where
from cucumbervision_greenhouse.settings import REPLAY_VARIABLE
from cucumbervision_greenhouse.store.waiting import waiting_folder

REACH_S = 0.15  # largest distance in time of a burst's frames from its press
FAR_S = 1.0  # a picture farther in time from a press shows another place
HELD_S = 90.0  # how late a press may arrive, and how long an unwatched camera stays open
PREVIEW_FPS = 15  # a D4xx offers 6, 15 and 30 at every size; aligning 30 takes a core
_DENSE_S, _SPARSE_S = 3.0, 0.25  # all frames are kept for so long, older ones at this distance
_MOST_FRAMES = 450
_MOST_BYTES, _RESERVE_BYTES = 2_000_000_000, 500_000_000  # of the ring; free space that it leaves
_CLOCK_S = 1.5  # the camera's time stamps differ by less from this machine's if both use one clock
_LOOK_S = 0.5  # interval of reports that somebody waits


class PictureGoneError(CameraError):
    """The picture of the moment of a press is no longer held."""

    def __init__(self) -> None:
        super().__init__("there is no picture of that moment any more", remedy="press again")


@dataclass(frozen=True)
class Preview:
    """What a feed shows now.

    Parameters
    ----------
    state : str
        'opening', 'live', 'playing' (a recording), 'replay' (a folder) or 'absent'.
    capture : Capture, optional
        The newest frame.
    quality : DepthQuality, optional
        How good its depth is.
    number : int
        Changes with every new frame.
    message : str
        Why there is no picture.
    """

    state: str
    capture: Capture | None = None
    quality: DepthQuality | None = None
    number: int = 0
    message: str = ""


class StreamCamera:
    """A RealSense camera; with `playback` a recording, played at the rate of the preview."""

    def __init__(self, config: CameraConfig) -> None:
        self._config, self.settings = replace(config, burst=1), config.settings
        self.state = "live" if config.playback is None else "playing"
        self._read_count, self._begun_s = 0, 0.0

    def __enter__(self) -> Self:
        self._camera = RealSenseCamera(replace(self._config, settings=self.settings))
        self._camera.__enter__()
        self._read_count, self._begun_s = 0, time.monotonic()
        return self

    def __exit__(self, *error: object) -> None:
        self._camera.__exit__(*error)

    def read(self) -> Capture | None:
        """Wait for the next frame with depth."""
        while True:
            try:
                capture = self._camera.capture_burst()
            except DepthError:  # something is too close to the camera
                continue
            except CameraError:
                if self.state == "playing" and self._read_count:
                    return None
                raise
            self._read_count += 1
            if self.state == "playing":
                due_s = self._begun_s + self._read_count / self._config.fps
                time.sleep(max(0.0, due_s - time.monotonic()))
            return capture


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame in the ring: its slot, and a capture whose arrays lie there."""

    at_s: float
    slot: int
    capture: Capture


class FrameRing:
    """The newest frames of a camera in a memory-mapped file, which goes with the program.

    Parameters
    ----------
    folder : Path
        Where the file is; created with the first frame.
    most : int
        Frames at most.
    """

    def __init__(self, folder: Path, most: int = _MOST_FRAMES) -> None:
        self._folder, self._most = folder, most
        self._slots: NDArray[Any] = np.empty(0)
        self._free: list[int] = []
        self.frames: list[_Frame] = []  # the oldest first

    def put(self, capture: Capture, at_s: float) -> None:
        """Add a frame, and remove those that are too old.

        Raises
        ------
        CameraError
            If the disk has no room for it.
        """
        arrays: dict[str, NDArray[Any]] = {"depth_m": capture.depth_m, "color": capture.color}
        kind = np.dtype([(name, array.dtype, array.shape) for name, array in arrays.items()])
        if self._slots.dtype != kind:
            self._allocate(kind)
        self._thin(at_s)
        slot = self._free.pop()
        for name, array in arrays.items():
            self._slots[name][slot] = array
        places: dict[str, Any] = {name: self._slots[name][slot] for name in arrays}
        self.frames.append(_Frame(at_s, slot, replace(capture, **places)))

    def clear(self) -> None:
        """Remove all frames and the file."""
        self.frames, self._free, self._slots = [], [], np.empty(0)

    def _allocate(self, kind: np.dtype[Any]) -> None:
        self.clear()
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            room = min(_MOST_BYTES, shutil.disk_usage(self._folder).free - _RESERVE_BYTES)
            count = min(room // kind.itemsize, self._most)
            if count < 1:
                raise OSError("no space left on the device")
            with tempfile.TemporaryFile(dir=self._folder) as file:
                if hasattr(os, "posix_fallocate"):  # a full disk is an error here, not a crash
                    os.posix_fallocate(file.fileno(), 0, count * kind.itemsize)
                else:
                    file.truncate(count * kind.itemsize)
                self._slots = np.memmap(file, kind, "r+", shape=(count,))
        except OSError as error:
            fault = with_reason("cannot keep its frames", str(error))
            raise CameraError(fault, source=self._folder, remedy="free some space") from None
        self._free = list(range(count))

    def _thin(self, now_s: float) -> None:
        kept: list[_Frame] = []
        for frame in self.frames:
            age_s = now_s - frame.at_s
            is_new = age_s <= _DENSE_S or not kept or frame.at_s - kept[-1].at_s >= _SPARSE_S
            if 0 <= age_s <= HELD_S and is_new:
                kept.append(frame)
            else:
                self._free.append(frame.slot)
        if not self._free:
            self._free.append(kept.pop(0).slot)
        self.frames = kept


class Feed:
    """A camera for any number of viewers, open while somebody looks.

    Parameters
    ----------
    camera : StreamCamera
        The source of the frames.
    folder : Path
        For the file of the ring.
    unwatched_s : float
        The camera is released after this time without a viewer.
    """

    def __init__(self, camera: StreamCamera, folder: Path, *, unwatched_s: float = HELD_S) -> None:
        self._camera, self._unwatched_s = camera, unwatched_s
        self._timeout_s = CameraConfig().timeout_s
        self._changed = threading.Condition()  # holds the lock of all that follows
        self._ring = FrameRing(folder)
        self._thread: threading.Thread | None = None
        self._watched_s = -math.inf
        self._reopens = False
        self._state, self._message, self._count = "opening", "", 0
        self._shown = Preview("opening", number=-1)

    def preview(self) -> Preview:
        """Return the newest frame; open the camera if necessary."""
        with self._changed:
            self._watch()
            if self._shown.number == self._count:
                return self._shown
            shown = Preview(self._state, number=self._count, message=self._message)
            frames = [replace(x, capture=_copied(x.capture)) for x in self._ring.frames[-2:]]
        if frames:  # the camera's thread does not wait until the quality is known
            shown = replace(shown, capture=frames[-1].capture, quality=_quality(frames))
        self._shown = shown
        return shown

    def retry(self) -> None:
        """Search for an absent camera again."""
        with self._changed:
            if self._thread is None:
                self._tell("opening")

    def configure(self, chosen: CameraSettings) -> None:
        """Stream with these settings; an open camera is opened again."""
        with self._changed:
            if chosen != self._camera.settings:
                self._camera.settings, self._reopens = chosen, True
                self._changed.notify_all()
        self.retry()

    def grab(self, burst: int, pressed_s: float) -> Capture:
        """Return the capture that is fused from the frames nearest to a moment.

        Waits for frames that may still arrive.

        Parameters
        ----------
        burst : int
            Frames at most, none farther from the moment than `REACH_S`, or than so many frames
            take, unless there is none nearer.
        pressed_s : float
            The moment, seconds since 1970: up to `HELD_S` ago.

        Raises
        ------
        PictureGoneError
            If no picture of that moment is held or can still arrive.
        CucumberVisionError
            If the camera is absent or sends nothing in time.
        """
        reach_s = max(REACH_S, (burst - 1) / 2 / PREVIEW_FPS)
        until_s = time.monotonic() + self._timeout_s + burst
        with self._changed:
            self._watch()
            is_late = time.time() - pressed_s > FAR_S
            while not (is_late or self._is_past(pressed_s + reach_s)):
                if self._state == "absent" or time.monotonic() > until_s:
                    break
                self._changed.wait(_LOOK_S)
                self._watch()
            away_s = {frame: abs(frame.at_s - pressed_s) for frame in self._ring.frames}
            nearest = [x for x in sorted(away_s, key=away_s.__getitem__) if away_s[x] <= FAR_S]
            if not nearest:
                if is_late or self._is_past(pressed_s):
                    raise PictureGoneError
                if self._state == "absent":
                    raise CameraError(self._message, remedy="try again")
                raise CameraError("the camera sends nothing", remedy="check its cable")
            frames = [x for x in nearest if away_s[x] <= reach_s][:burst] or nearest[:1]
            captures = [_copied(x.capture) for x in sorted(frames, key=lambda x: x.at_s)]
        if len(captures) == 1:
            return captures[0]
        fused = fuse_burst([x.color for x in captures], [x.depth_m for x in captures])
        first, chosen = captures[0], captures[fused.burst_frame]
        return replace(chosen, **vars(fused), name=first.name, frame=first.frame)

    def close(self) -> None:
        """Release the camera."""
        with self._changed:
            self._watched_s, thread = -math.inf, self._thread
            self._changed.notify_all()
        if thread is not None:
            thread.join(self._timeout_s)

    def _watch(self) -> None:
        """Report a viewer; open the camera unless it is open or absent."""
        self._watched_s = time.monotonic()
        if self._thread is None and self._state != "absent":
            self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        state, message = "opening", ""
        try:
            while self._read():
                pass  # the recording has ended, or the settings have changed
        except CucumberVisionError as error:
            state, message = "absent", error.line
        except Exception as error:  # the page shows it instead of the picture
            state, message = "absent", f"{type(error).__name__}: {error}"
        with self._changed:
            self._thread = None
            self._ring.clear()
            self._tell(state, message)

    def _read(self) -> bool:
        """Read frames; return False without a viewer, True if the camera must be opened again."""
        self._reopens = False
        with self._camera as camera:
            while time.monotonic() - self._watched_s < self._unwatched_s and not self._reopens:
                capture = camera.read()
                if capture is None:
                    return True
                with self._changed:
                    self._ring.put(capture, _taken_s(capture, time.time()))
                    self._tell(camera.state)
        return self._reopens

    def _is_past(self, at_s: float) -> bool:
        """Return whether the newest frame is of this moment or later."""
        return bool(self._ring.frames) and self._ring.frames[-1].at_s >= at_s

    def _tell(self, state: str, message: str = "") -> None:
        self._state, self._message = state, message
        self._count += 1
        self._changed.notify_all()


def _quality(frames: list[_Frame]) -> DepthQuality:
    """Return how good the last frame's depth is, for which the camera's motion counts."""
    *before, frame = frames
    capture = frame.capture
    is_next = before and frame.at_s - before[0].at_s <= REACH_S
    if is_next and before[0].capture.color.shape == capture.color.shape:
        [moved] = moved_px(before[0].capture.color, [capture.color])
        capture = replace(capture, moved_px=moved)
    return depth_quality(capture)


class FolderFeed:
    """Captures of a folder in turn, again and again: each press takes the one that is shown.

    A folder has no moments, so that late presses, and those before a restart, get captures as well.

    Parameters
    ----------
    path : Path
        Folder or file that `open_source` knows.
    burst : int
        Frames that are fused, as in `ReadOptions`.
    """

    def __init__(self, path: Path, burst: int = 5) -> None:
        self._source = open_source(path, ReadOptions(burst=burst))
        self._refs: Iterator[CaptureRef] = iter(())
        self._lock = threading.Lock()
        self._shown: Preview | None = None
        self._count = 0

    def preview(self) -> Preview:
        """Return the capture that the next press takes."""
        with self._lock:
            self._shown = self._shown or self._next()
            return self._shown

    def grab(self, burst: int, pressed_s: float) -> Capture:  # noqa: ARG002, as of `Feed`
        """Return the capture that is shown, and go on to the next.

        Raises
        ------
        CameraError
            If none can be read.
        """
        with self._lock:
            shown = self._shown or self._next()
            if shown.capture is None:
                raise CameraError(shown.message, remedy="choose another replay")
            self._shown = None
            return shown.capture

    def _next(self) -> Preview:
        """Read the next capture that can be read."""
        self._count += 1
        fault = Message("holds no captures")
        for _ in range(2):  # at the end start over once
            for ref in self._refs:
                try:
                    capture = ref.load()
                    return Preview("replay", capture, depth_quality(capture), self._count)
                except CucumberVisionError as error:
                    fault = error.line
            self._refs = iter(self._source)
        return Preview("absent", number=self._count, message=fault)


def _copied(capture: Capture) -> Capture:
    return replace(capture, color=capture.color.copy(), depth_m=capture.depth_m.copy())


def _taken_s(capture: Capture, now_s: float) -> float:
    """Return the camera's time stamp if its clock is this machine's, else the time of arrival."""
    camera_s = capture.timestamp_s
    return camera_s if camera_s is not None and 0 <= now_s - camera_s < _CLOCK_S else now_s


def _feed_of(name: str, config: CameraConfig) -> Feed:
    feed = Feed(StreamCamera(config), waiting_folder(where()).with_suffix(".frames") / name)
    atexit.register(feed.close)  # the next program may need the camera at once
    return feed


@st.cache_resource(show_spinner=False)
def camera() -> Feed:
    """Return the camera, which opens for its first viewer."""
    return _feed_of("camera", CameraConfig(fps=PREVIEW_FPS, settings=settings().camera))


@st.cache_resource(show_spinner=False)
def _replay(burst: int) -> Feed | FolderFeed:
    chosen = Path(os.environ.get(REPLAY_VARIABLE) or example_captures())
    if chosen.suffix.lower() in RECORDING_SUFFIXES:
        # As a camera would send it, so that a walk can be tried.
        return _feed_of("replay", CameraConfig(playback=chosen, warm_up=0, fps=PREVIEW_FPS))
    return FolderFeed(chosen, burst)


def replay_named() -> bool:
    """Return whether the command named a replay, which is then shown first."""
    return bool(os.environ.get(REPLAY_VARIABLE))


def feed(kind: str) -> Feed | FolderFeed:
    """Return the camera, or for 'replay' the replay.

    Raises
    ------
    CaptureError
        If the replay cannot be read.
    """
    return _replay(settings().burst) if kind == "replay" else camera()
