"""The camera's newest frame for any number of viewers, the quality of its depth, and a replay.

A thread opens the camera when somebody views it and releases it when nobody has for a while.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

from cucumbervision.capture.frames import fuse_burst
from cucumbervision.capture.quality import DepthQuality, depth_quality
from cucumbervision.capture.readers import CaptureRef, ReadOptions, open_source
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.errors import CameraError, CaptureError, CucumberVisionError

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision.capture.frames import Capture, Stop

__all__ = ["CameraFeed", "Feed", "Preview", "Replay"]

UNWATCHED_S = 6.0  # viewers ask several times a second
PREVIEW_FPS = 15  # a D4xx offers 6, 15 and 30 at every size; aligning 30 takes a core


@dataclass(frozen=True)
class Preview:
    """What a feed shows now.

    Parameters
    ----------
    state : str
        'opening', 'live', 'replay' or 'absent'.
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


class CameraFeed:
    """A camera in a thread of its own.

    Parameters
    ----------
    config : CameraConfig, optional
        What to stream, or what recording to play in the camera's place; bursts are made here, so
        its `burst` does not count.
    unwatched_s : float
        The camera is released when nobody has looked for so long.
    """

    def __init__(
        self, config: CameraConfig | None = None, unwatched_s: float = UNWATCHED_S
    ) -> None:
        self._config = replace(config or CameraConfig(fps=PREVIEW_FPS), burst=1)
        self._unwatched_s = unwatched_s
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._newest: Preview = Preview("opening")
        self._watched_s = 0.0
        self._stopping = False
        self._filling: list[Capture] = []
        self._wanted = 0

    @property
    def open(self) -> bool:
        """Whether the thread holds the camera."""
        return self._thread is not None and self._thread.is_alive()

    def preview(self) -> Preview:
        """Return the newest frame; begins to stream if it did not."""
        self._watched_s = time.monotonic()
        with self._changed:
            if not self.open and self._newest.state != "absent":
                self._begin()
            return self._newest

    def retry(self) -> None:
        """Search for the camera again."""
        with self._changed:
            if not self.open:
                self._newest = Preview("opening", number=self._newest.number)

    def take(self, burst: int, stop: Stop) -> Capture:
        """Return a capture fused from the next frames.

        Raises
        ------
        CameraError
            If the camera is not there, or sends nothing in time.
        """
        frames: list[Capture] = []
        until = time.monotonic() + self._config.timeout_s + burst
        with self._changed:
            self._filling, self._wanted = frames, burst
            self._watched_s = time.monotonic()
            if not self.open and self._newest.state != "absent":
                self._begin()
            while len(frames) < burst:
                if self._newest.state == "absent" or time.monotonic() > until:
                    message = self._newest.message or "the camera sends nothing"
                    raise CameraError(message, remedy="check its cable and try again")
                self._changed.wait(0.2)
        color, depth_m, kept = fuse_burst([f.color for f in frames], [f.depth_m for f in frames])
        chosen = frames[kept]
        return replace(
            chosen,
            color=color,
            depth_m=depth_m,
            name=f"capture_{frames[0].frame:06d}",
            frame=frames[0].frame,
            burst_frame=kept,
            burst_size=burst,
            stop=stop,
        )

    def close(self) -> None:
        """Release the camera."""
        self._stopping = True
        thread = self._thread
        if thread is not None:
            thread.join(self._config.timeout_s + 5)

    def _begin(self) -> None:
        self._stopping = False
        self._newest = Preview("opening", number=self._newest.number)
        self._thread = threading.Thread(target=self._stream, name="camera", daemon=True)
        self._thread.start()

    def _stream(self) -> None:
        try:
            with RealSenseCamera(self._config) as camera:
                while not self._stopping:
                    if time.monotonic() - self._watched_s > self._unwatched_s:
                        break
                    capture = camera.capture_burst()
                    self._show(
                        Preview("live", capture, depth_quality(capture), self._newest.number + 1)
                    )
            self._show(Preview("opening", number=self._newest.number + 1))
        except CucumberVisionError as error:
            self._show(Preview("absent", number=self._newest.number + 1, message=str(error)))

    def _show(self, preview: Preview) -> None:
        with self._changed:
            self._newest = preview
            if preview.capture is not None and len(self._filling) < self._wanted:
                self._filling.append(preview.capture)
            self._changed.notify_all()


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


Feed: TypeAlias = CameraFeed | Replay
"""A source of frames to show and of captures to measure."""
