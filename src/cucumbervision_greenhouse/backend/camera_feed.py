"""The camera's newest frame for any number of viewers, the quality of its depth, and bursts.

A process of its own (`camera_process.py`) opens the camera when somebody views it, and releases it
when nobody has for a while; its frames are read from the ring on disk that it writes.
"""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

from cucumbervision.capture.frames import Stop, fuse_burst
from cucumbervision.capture.motion import moved_px
from cucumbervision.capture.quality import DepthQuality, depth_quality
from cucumbervision.capture.realsense import CameraConfig
from cucumbervision.errors import CameraError, CaptureError, StoreError
from cucumbervision_greenhouse.backend.camera_process import CameraFolder

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.raw_frames import RingFrame
    from cucumbervision.capture.realsense_device import CameraSettings
    from cucumbervision_greenhouse.store.waiting import Waiting, WaitingCaptures

REACH_S = 0.15  # largest distance in time of a burst's frames from its press
FAR_S = 1.0  # a picture farther in time from a press shows another place
HELD_S = 90.0  # how late a press may arrive, and how long an unwatched camera stays open
PREVIEW_FPS = 15  # a D4xx offers 6, 15 and 30 at every size; aligning 30 takes a core
_LOOK_S, _WATCH_S = 0.02, 0.5  # intervals: checks for a frame; reports of a viewer
_END_S = 10.0  # longest wait for the camera's process
_MOST_LOOKS = 20  # attempts, since frames may leave the ring while they are linked
_MOST_CRASHES = 3  # failed starts in a row, after which the camera's process is not started


class PictureGoneError(CameraError):
    """The picture of the moment of a press is no longer held."""


def picture_gone() -> PictureGoneError:
    """Return the error of a press whose picture is no longer held."""
    return PictureGoneError("there is no picture of that moment any more", remedy="press again")


@dataclass(frozen=True)
class Preview:
    """What a feed shows now.

    Parameters
    ----------
    state : str
        'opening', 'live', 'playing' (a recording), 'replay' or 'absent'.
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


class Recorder(Protocol):
    """A process that writes a camera's frames."""

    def poll(self) -> int | None:
        """Return its exit code; None while it runs."""
        ...


def start_process(folder: Path) -> Recorder:
    """Start the camera's process, which outlives this one."""
    command = [
        sys.executable,
        "-m",
        "cucumbervision_greenhouse.backend.camera_process",
        str(folder),
    ]
    # In a session of its own, so that Ctrl-C at the server's terminal does not end it.
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    # Its end is noted even if no viewer is left.
    threading.Thread(target=process.wait, name="camera", daemon=True).start()
    return process


class CameraBurst:
    """The frames nearest to a moment; the last of them may still arrive."""

    simulated = False

    def __init__(
        self, feed: CameraFeed, frame_count: int, pressed_s: float, reach_s: float
    ) -> None:
        self._feed, self._reach_s = feed, reach_s
        self.frame_count, self.pressed_s = frame_count, pressed_s
        self.frames: list[RingFrame] = []
        self.is_full = False
        self.look()

    def look(self) -> bool:
        """Choose the nearest available frames; return whether no later frame can be nearer."""
        frames = [frame for frame in self._feed.frames() if frame.at_s >= self._earliest_s]
        if frames and not self.is_full:
            by_distance = sorted(frames, key=self._away_s)
            within = [frame for frame in by_distance if self._away_s(frame) <= self._reach_s]
            nearest = (within or by_distance[:1])[: self.frame_count]
            self.frames = sorted(nearest, key=lambda frame: frame.at_s)
            enough_s = self.farthest_s if len(nearest) == self.frame_count else self._reach_s
            self.is_full = frames[-1].at_s - self.pressed_s >= enough_s
        return self.is_full

    @property
    def _earliest_s(self) -> float:
        """A burst of future frames excludes earlier ones."""
        return self.pressed_s if math.isinf(self._reach_s) else -math.inf

    def _away_s(self, frame: RingFrame) -> float:
        return abs(frame.at_s - self.pressed_s)

    @property
    def nearest_s(self) -> float:
        """How far in time the nearest frame lies from the press, seconds."""
        return min(map(self._away_s, self.frames), default=math.inf)

    @property
    def farthest_s(self) -> float:
        """How far in time the farthest frame lies from the press, seconds."""
        return max(map(self._away_s, self.frames), default=math.inf)

    def keep(self, waiting: WaitingCaptures, key: str, round_key: str, stop: Stop) -> Waiting:
        """Wait for the last frames, and save all of them uncoded.

        Raises
        ------
        CameraError
            If the picture of the moment is gone, or the camera sends nothing in time.
        StoreError
            If they cannot be kept.
        """
        # The ring may have dropped some in between: then use those that it still holds.
        for _ in range(_MOST_LOOKS):
            self._feed.wait_for(self)
            if self.nearest_s > FAR_S:
                break
            paths = [frame.path for frame in self.frames]
            description = (stop, key, round_key, self.pressed_s, self._feed.source)
            try:
                return waiting.put_frames(paths, *description)
            except StoreError as error:
                if not isinstance(error.__cause__, FileNotFoundError):
                    raise
            self.frames, self.is_full = [], False
        raise picture_gone()

    def capture(self) -> Capture:
        """Wait for the last frames, and return the capture fused from all.

        Raises
        ------
        CameraError
            If the camera is not there, or sends nothing in time.
        """
        self._feed.wait_for(self)
        frames = [frame.load() for frame in self.frames]
        fused = fuse_burst([f.color for f in frames], [f.depth_m for f in frames])
        name = f"capture_{frames[0].frame:06d}"
        return replace(frames[fused.burst_frame], **vars(fused), name=name, frame=frames[0].frame)


class CameraFeed:
    """A camera in a process of its own.

    Parameters
    ----------
    folder : Path
        Holds its frames and the files that control its process.
    config : CameraConfig, optional
        What to stream, or which recording to play instead of the camera. Its `burst` is ignored,
        since bursts are made here.
    unwatched_s : float
        The camera is released after this time without a viewer.
    paced : bool
        Play a recording at `config.fps` instead of as fast as it can be read.
    start : callable
        Starts the process that writes the frames into the folder.
    """

    def __init__(
        self,
        folder: Path,
        config: CameraConfig | None = None,
        *,
        unwatched_s: float = HELD_S,
        paced: bool = False,
        start: Callable[[Path], Recorder] = start_process,
    ) -> None:
        self._config = replace(config or CameraConfig(fps=PREVIEW_FPS), burst=1)
        self._unwatched_s, self._paced, self._start = unwatched_s, paced, start
        self._talk = CameraFolder(folder)
        self._lock = threading.Lock()
        self._recorder: Recorder | None = None
        self._crashes, self._tried = 0, False
        self._watched_s = -math.inf
        self._newest, self._newest_at_s = Preview("opening"), -math.inf

    @property
    def open(self) -> bool:
        """Whether a process holds the camera."""
        return self._talk.is_held()

    @property
    def source(self) -> str:
        """The source of its captures."""
        serial = self._config.serial
        return str(self._config.playback or (f"camera {serial}" if serial else "camera"))

    def frames(self) -> list[RingFrame]:
        """Return the frames that are held, the oldest first."""
        return self._talk.ring.frames()

    def preview(self) -> Preview:
        """Return the newest frame; start to stream if necessary."""
        with self._lock:
            self._begin_watched()
            state, message = self._talk.state()
            frames = self.frames()[-2:] if state in ("live", "playing") else []
            if not frames:
                if (state, message) != (self._newest.state, self._newest.message):
                    number = self._newest.number + 1
                    self._newest = Preview(state, number=number, message=message)
            elif frames[-1].at_s != self._newest_at_s:
                self._newest_at_s = frames[-1].at_s
                self._newest = self._shown(state, frames) or self._newest
            return self._newest

    def retry(self) -> None:
        """Search for the camera again."""
        with self._lock:
            if not self.open:
                self._tried, self._crashes = False, 0

    def configure(self, settings: CameraSettings) -> None:
        """Stream with these settings; an open camera is opened again."""
        with self._lock:
            if settings == self._config.settings:
                return
            self._config = replace(self._config, settings=settings)
            self._ask()
        self.retry()

    def grab(self, burst: int, pressed_s: float) -> CameraBurst:
        """Begin a burst of the frames nearest to a moment; later ones may still arrive.

        Frames that lie farther from the moment than `REACH_S`, or than so many frames take, are
        left out, unless there is none nearer.

        Parameters
        ----------
        burst : int
            Frames at most.
        pressed_s : float
            The moment, seconds since 1970: up to `HELD_S` ago.

        Raises
        ------
        PictureGoneError
            If no picture of that moment is held or can still arrive.
        """
        with self._lock:
            self._begin_watched()
        reach_s = max(REACH_S, (burst - 1) / 2 / self._config.fps)
        grabbed = CameraBurst(self, burst, pressed_s, reach_s)
        if min(grabbed.nearest_s, time.time() - pressed_s) > FAR_S:
            raise picture_gone()
        return grabbed

    def take(self, burst: int, stop: Stop) -> Capture:
        """Return a capture fused from the next frames.

        Raises
        ------
        CameraError
            If the camera is not there, or sends nothing in time.
        """
        return replace(CameraBurst(self, burst, time.time(), math.inf).capture(), stop=stop)

    def wait_for(self, grabbed: CameraBurst) -> None:
        """Wait until a burst has all its frames.

        Raises
        ------
        CameraError
            If the camera is not there, or sends nothing in time.
        """
        until = time.monotonic() + self._config.timeout_s + grabbed.frame_count
        while not grabbed.is_full:
            with self._lock:
                self._begin_watched()
            if grabbed.look():
                return
            state, message = self._talk.state()
            if state == "absent" or time.monotonic() > until:
                if grabbed.nearest_s <= FAR_S:  # the available frames are enough
                    return
                fault = message if state == "absent" else "the camera sends nothing"
                raise CameraError(fault, remedy="check its cable and try again")
            time.sleep(_LOOK_S)

    def close(self) -> None:
        """Release the camera."""
        self.end()
        until = time.monotonic() + self._config.timeout_s + _END_S
        while self._runs() and time.monotonic() < until:
            time.sleep(_LOOK_S)

    def end(self) -> None:
        """Ask the process to release the camera, without waiting for it."""
        self._talk.end()

    def _runs(self) -> bool:
        return self.open or (self._recorder is not None and self._recorder.poll() is None)

    def _begin_watched(self) -> None:
        """Report a viewer; start the process unless it runs or has found no camera."""
        if self._tried and self._talk.state()[0] == "absent":
            return
        if time.monotonic() - self._watched_s > _WATCH_S:
            self._talk.watch()
            self._watched_s = time.monotonic()
        if self._runs():
            self._tried = True
            return
        code = None if self._recorder is None else self._recorder.poll()
        if code:
            self._crashes += 1
        if self._crashes >= _MOST_CRASHES:
            self._talk.tell("absent", f"the camera's program ended {self._crashes} times ({code})")
            return
        self._ask()
        self._talk.watch()
        self._talk.tell("opening")
        self._recorder, self._tried = self._start(self._talk.path), True

    def _ask(self) -> None:
        self._talk.ask(self._config, unwatched_s=self._unwatched_s, paced=self._paced)

    def _shown(self, state: str, frames: list[RingFrame]) -> Preview | None:
        """Return the last of two frames, with the motion since the one before."""
        try:
            *before, capture = [frame.load() for frame in frames]
        except CaptureError:  # a frame has just left the ring
            return None
        looked_at = capture
        is_next = frames[-1].at_s - frames[0].at_s <= REACH_S
        if before and is_next and before[0].color.shape == capture.color.shape:
            [moved] = moved_px(before[0].color, [capture.color])
            looked_at = replace(capture, moved_px=moved)
        self._crashes = 0
        return Preview(state, capture, depth_quality(looked_at), self._newest.number + 1)
