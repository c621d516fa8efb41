"""Record what the camera shows: a capture every so often, beside presses and measuring."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Self

from cucumbervision.capture.recorder import Recorded, Walk, record_captures
from cucumbervision.errors import named_error

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from cucumbervision.capture.frames import Capture, Stop
    from cucumbervision.dashboard.camera_feed import Feed

_EVERY_S = 1.0


@dataclass
class Recording:
    """One recording: where it goes, how many captures it has, what went wrong last.

    Parameters
    ----------
    folder : Path
        Gets a native capture folder each.
    taken : int
        Captures so far.
    fault : str
        Empty where nothing went wrong.
    """

    folder: Path
    taken: int = 0
    fault: str = ""
    ending: threading.Event = field(default_factory=threading.Event, repr=False)
    thread: threading.Thread | None = field(default=None, repr=False)

    @property
    def running(self) -> bool:
        """Whether captures are taken, and nobody has ended that."""
        return self.thread is not None and self.thread.is_alive() and not self.ending.is_set()


class Recorder:
    """Records one thing at a time, in a thread of its own.

    Parameters
    ----------
    folder : Path
        Gets a folder a recording, named by its beginning.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self.newest: Recording | None = None

    def begin(self, feed: Feed, burst: int, walk: Walk, every_s: float = _EVERY_S) -> Recording:
        """Begin to record a feed; what is being recorded already goes on instead."""
        with self._lock:
            if self.newest is None or not self.newest.running:
                if self.newest is not None and self.newest.thread is not None:
                    self.newest.thread.join()  # it may still write its last capture
                begun = Recording(self._folder / time.strftime("%Y-%m-%d_%H-%M-%S"))
                begun.thread = threading.Thread(
                    target=_record, args=(begun, feed, burst, walk, every_s), daemon=True
                )
                begun.thread.start()
                self.newest = begun
            return self.newest

    def end(self) -> None:
        """End the recording after the capture that is being taken."""
        if self.newest is not None:
            self.newest.ending.set()


def _record(begun: Recording, feed: Feed, burst: int, walk: Walk, every_s: float) -> None:
    def signals() -> Iterator[None]:
        while not begun.ending.is_set():
            next_s = time.monotonic() + every_s
            yield
            begun.ending.wait(max(0.0, next_s - time.monotonic()))

    def opened() -> _FeedCamera:
        return _FeedCamera(feed, burst)

    try:
        for one in record_captures(opened, begun.folder, signals(), walk):
            if isinstance(one, Recorded):
                begun.taken += 1
            else:
                begun.fault = str(one)
    except Exception as error:
        begun.fault = str(named_error(error, begun.folder))


class _FeedCamera:
    """The pages' own camera as `capture.camera.RgbdCamera`: it is shared, and stays open."""

    def __init__(self, feed: Feed, burst: int) -> None:
        self.device = {"camera": "dashboard"}
        self._feed, self._burst = feed, burst

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def capture_burst(self, name: str | None = None, *, stop: Stop | None = None) -> Capture:
        capture = self._feed.grab(self._burst, time.time()).capture()
        return replace(capture, name=name or capture.name, stop=stop or capture.stop)
