"""The camera's newest frame for any number of viewers, the quality of its depth, and a replay.

A thread opens the camera when somebody views it and releases it when nobody has for a while.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

from cucumbervision.capture.frames import Stop, fuse_burst
from cucumbervision.capture.motion import moved_px
from cucumbervision.capture.quality import DepthQuality, depth_quality
from cucumbervision.capture.readers import CaptureRef, ReadOptions, open_source
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.errors import CameraError, CaptureError, CucumberVisionError

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.realsense_device import CameraSettings

REACH_S = 0.15  # how far from its press a burst's frames may be: nobody walks far meanwhile
FAR_S = 1.0  # a picture that lies farther from a press is another one
_HELD_S = 10.0  # how late a press may reach us: frames of so long are held
_DENSE_S, _SPARSE_S = 1.5, 0.25  # all of them so long, then one in so many: each takes 6 MB
_UNWATCHED_S = 15.0  # viewers ask several times a second, but where their connection has a gap
PREVIEW_FPS = 15  # a D4xx offers 6, 15 and 30 at every size; aligning 30 takes a core


def picture_gone() -> CameraError:
    """Return the error of a press whose picture is not there."""
    return CameraError("there is no picture of that moment any more", remedy="press again")


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
        Why there is nothing to see.
    """

    state: str
    capture: Capture | None = None
    quality: DepthQuality | None = None
    number: int = 0
    message: str = ""


@dataclass(frozen=True, eq=False)
class _Held:
    """A frame, and when it was taken, seconds since 1970."""

    at_s: float
    capture: Capture


class CameraBurst:
    """The frames nearest to a moment, of which the last may still be on their way."""

    def __init__(
        self, feed: CameraFeed, wanted: int, pressed_s: float, reach_s: float, held: list[_Held]
    ) -> None:
        self._feed, self._reach_s = feed, reach_s
        self.wanted, self.pressed_s = wanted, pressed_s
        self.frames: list[_Held] = []
        self.is_full = False
        for one in held:
            self.offer(one)

    def offer(self, held: _Held) -> None:
        """Take the next frame if it is among the nearest; the first that is not ends the burst."""
        if self.is_full:
            return
        frames = sorted([*self.frames, held], key=self._away_s)
        within = [one for one in frames if self._away_s(one) <= self._reach_s] or frames[:1]
        self.frames = sorted(within[: self.wanted], key=lambda one: one.at_s)
        # Those that follow lie farther after the press than this one.
        enough_s = self.farthest_s if len(self.frames) == self.wanted else self._reach_s
        self.is_full = held.at_s - self.pressed_s >= enough_s

    def _away_s(self, held: _Held) -> float:
        return abs(held.at_s - self.pressed_s)

    @property
    def nearest_s(self) -> float:
        """How far in time the nearest frame lies from the press, seconds."""
        return min(map(self._away_s, self.frames))

    @property
    def farthest_s(self) -> float:
        """How far in time the farthest frame lies from the press, seconds."""
        return max(map(self._away_s, self.frames))

    def capture(self) -> Capture:
        """Wait for the last frames, and return the capture that all make together.

        Raises
        ------
        CameraError
            If the camera is not there, or sends nothing in time.
        """
        self._feed.wait_for(self)
        frames = [one.capture for one in self.frames]
        fused = fuse_burst([f.color for f in frames], [f.depth_m for f in frames])
        return replace(
            frames[fused.burst_frame],
            **vars(fused),
            name=f"capture_{frames[0].frame:06d}",
            frame=frames[0].frame,
        )


class ReplayBurst:
    """What a replay shows when the button is pressed."""

    nearest_s = 0.0  # a replay stands still

    def __init__(self, replay: Replay, shown: Capture | None) -> None:
        self._replay = replay
        self._shown = shown

    def capture(self) -> Capture:
        """Return the capture.

        Raises
        ------
        CaptureError
            If nothing of the replay can be read.
        """
        return self._shown or self._replay.take(1, Stop())


class CameraFeed:
    """A camera in a thread of its own.

    Parameters
    ----------
    config : CameraConfig, optional
        What to stream, or what recording to play in the camera's place; bursts are made here, so
        its `burst` does not count.
    unwatched_s : float
        The camera is released when nobody has looked for so long.
    paced : bool
        Play a recording at `config.fps`, as a camera would send it, not as fast as it is read.
    """

    def __init__(
        self,
        config: CameraConfig | None = None,
        unwatched_s: float = _UNWATCHED_S,
        *,
        paced: bool = False,
    ) -> None:
        self._config = replace(config or CameraConfig(fps=PREVIEW_FPS), burst=1)
        self._paced = paced
        self._state = "live" if self._config.playback is None else "playing"
        self._unwatched_s = unwatched_s
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._newest: Preview = Preview("opening")
        self._watched_s = 0.0
        self._stopping = False
        self._filling: list[CameraBurst] = []
        self._held: list[_Held] = []

    @property
    def open(self) -> bool:
        """Whether the thread holds the camera."""
        return self._thread is not None and self._thread.is_alive()

    def preview(self) -> Preview:
        """Return the newest frame; begins to stream if it did not."""
        with self._changed:
            self._begin_watched()
            return self._newest

    def retry(self) -> None:
        """Search for the camera again."""
        with self._changed:
            if not self.open:
                self._newest = Preview("opening", number=self._newest.number)

    def configure(self, settings: CameraSettings) -> None:
        """Stream with these settings: a camera that is open is opened again."""
        with self._changed:
            if settings != self._config.settings:
                self._config = replace(self._config, settings=settings)
                self.retry()

    def grab(self, burst: int, pressed_s: float) -> CameraBurst:
        """Begin a burst of the frames nearest to a moment: the earlier are there, the others come.

        Frames that lie farther from the moment than `REACH_S`, or than so many frames take, are
        left out, unless there is none nearer.

        Parameters
        ----------
        burst : int
            Frames at most.
        pressed_s : float
            The moment, seconds since 1970: up to `_HELD_S` ago.

        Raises
        ------
        CameraError
            If no picture of that moment is held, nor can come any more.
        """
        with self._changed:
            self._begin_watched()
            ago_s = [abs(pressed_s - one.at_s) for one in self._held]
            if min([*ago_s, time.time() - pressed_s]) > FAR_S:
                raise picture_gone()
            reach_s = max(REACH_S, (burst - 1) / 2 / self._config.fps)
            grabbed = CameraBurst(self, burst, pressed_s, reach_s, self._held)
            self._filling += [] if grabbed.is_full else [grabbed]
            return grabbed

    def take(self, burst: int, stop: Stop) -> Capture:
        """Return a capture fused from the next frames.

        Raises
        ------
        CameraError
            If the camera is not there, or sends nothing in time.
        """
        with self._changed:
            self._held.clear()
            grabbed = CameraBurst(self, burst, 0.0, math.inf, [])
            self._begin_watched()
            self._filling.append(grabbed)
        return replace(grabbed.capture(), stop=stop)

    def wait_for(self, grabbed: CameraBurst) -> None:
        """Wait until a burst has all its frames.

        Raises
        ------
        CameraError
            If the camera is not there, or sends nothing in time.
        """
        until = time.monotonic() + self._config.timeout_s + grabbed.wanted
        with self._changed:
            while not grabbed.is_full:
                self._watched_s = time.monotonic()
                if self._newest.state == "absent" or time.monotonic() > until:
                    self._filling = [one for one in self._filling if one is not grabbed]
                    message = self._newest.message or "the camera sends nothing"
                    raise CameraError(message, remedy="check its cable and try again")
                self._changed.wait(0.2)

    def close(self) -> None:
        """Release the camera."""
        self._stopping = True
        thread = self._thread
        if thread is not None:
            thread.join(self._config.timeout_s + 5)

    def _begin_watched(self) -> None:
        self._watched_s = time.monotonic()
        if not self.open and self._newest.state != "absent":
            self._begin()

    def _begin(self) -> None:
        self._stopping = False
        self._newest = Preview("opening", number=self._newest.number)
        self._thread = threading.Thread(target=self._stream, name="camera", daemon=True)
        self._thread.start()

    def _stream(self) -> None:
        try:
            while not self._stream_once():
                pass  # a recording is over, or the settings are new: it begins again
            self._held = []
            self._show(Preview("opening", number=self._newest.number + 1))
        except CucumberVisionError as error:
            self._show(Preview("absent", number=self._newest.number + 1, message=str(error)))

    def _stream_once(self) -> bool:
        """Show frames; return True where nobody looks any more, False where it is to begin anew."""
        shown, config = 0, self._config
        with RealSenseCamera(config) as camera:
            begun_s = time.monotonic()
            while not self._stopping:
                if self._config is not config:
                    return False
                if time.monotonic() - self._watched_s > self._unwatched_s:
                    return True
                try:
                    capture = camera.capture_burst()
                except CameraError:
                    if config.playback is None or not shown:
                        raise
                    return False
                now, number = time.time(), self._newest.number + 1
                # A press must not wait for what is only looked at.
                self._hold(capture, now)
                before, seen = self._newest.capture, capture
                if before is not None and before.color.shape == seen.color.shape:
                    [moved] = moved_px(before.color, [seen.color])
                    seen = replace(seen, moved_px=moved)
                self._show(Preview(self._state, capture, depth_quality(seen), number))
                shown += 1
                if self._paced:
                    time.sleep(max(0.0, begun_s + shown / config.fps - time.monotonic()))
        return True

    def _show(self, preview: Preview) -> None:
        with self._changed:
            self._newest = preview
            self._changed.notify_all()

    def _hold(self, capture: Capture, now: float) -> None:
        """Keep a frame for presses that are still on their way, and give it to open bursts."""
        own = capture.timestamp_s
        # The camera's own time where its clock is this machine's, else the time of arrival.
        live = own is not None and 0 <= now - own < _DENSE_S
        held = _Held(own if live and own is not None else now, capture)
        with self._changed:
            self._held = _thinned([*self._held, held], now)
            for grabbed in self._filling:
                grabbed.offer(held)
            self._filling = [one for one in self._filling if not one.is_full]
            self._changed.notify_all()


def _thinned(held: list[_Held], now: float) -> list[_Held]:
    """Return the frames to be held on: all new ones, some of the older, none that are too old."""
    kept: list[_Held] = []
    for one in held:
        is_new = now - one.at_s <= _DENSE_S
        if is_new or not kept or one.at_s - kept[-1].at_s >= _SPARSE_S:
            kept += [one] if now - one.at_s <= _HELD_S else []
    return kept


class Replay:
    """Captures of a folder or a recording in the camera's place; starts over at its end.

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
        self._lock = threading.Lock()
        self._newest = Preview("opening")
        self._begun_s = time.time()
        self._loader: threading.Thread | None = None

    def preview(self) -> Preview:
        """Return the capture that is taken next; a thread reads it."""
        with self._lock:
            if self._newest.state == "opening" and (
                self._loader is None or not self._loader.is_alive()
            ):
                self._start()
            return self._newest

    def take(self, burst: int, stop: Stop) -> Capture:  # noqa: ARG002, a replay's bursts are fused
        """Return the capture that is shown, and load the next.

        Raises
        ------
        CaptureError
            If nothing of the replay can be read.
        """
        self.preview()
        loader = self._loader
        if loader is not None:
            loader.join()
        preview = self._newest
        if preview.capture is None:
            raise CaptureError(
                preview.message or "nothing to replay", remedy="choose another replay"
            )
        with self._lock:
            self._newest = Preview("opening", preview.capture, None, preview.number)
            self._start()
        return replace(preview.capture, stop=stop)

    def grab(self, burst: int, pressed_s: float) -> ReplayBurst:  # noqa: ARG002, as a camera's
        """Take what is shown now, and load the next.

        Raises
        ------
        CameraError
            If the moment lies before the replay began, or as long ago as a camera holds nothing.
        """
        if pressed_s < max(self._begun_s, time.time() - _HELD_S):
            raise picture_gone()
        with self._lock:
            shown = self._newest.capture if self._newest.state == "replay" else None
            if shown is not None:
                self._newest = Preview("opening", shown, None, self._newest.number)
                self._start()
        return ReplayBurst(self, shown)

    def _start(self) -> None:
        self._loader = threading.Thread(target=self._load, name="replay", daemon=True)
        self._loader.start()

    def _load(self) -> None:
        number = self._newest.number + 1
        fault = "holds no captures"
        for _ in range(2):  # at the end from the beginning, once
            for ref in self._refs:
                try:
                    capture = ref.load()
                except CucumberVisionError as error:
                    fault = str(error)
                    continue
                self._newest = Preview("replay", capture, depth_quality(capture), number)
                return
            self._refs = iter(self._source)
        self._newest = Preview("absent", number=number, message=f"{self._source.path}: {fault}")


Burst: TypeAlias = CameraBurst | ReplayBurst
"""What a press of the button takes."""

Feed: TypeAlias = CameraFeed | Replay
"""A source of frames to show and of captures to measure."""
