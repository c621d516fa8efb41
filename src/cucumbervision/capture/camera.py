"""Interface of RGB-D cameras of any make, and a camera that watches a folder."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol, Self

from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.capture.source import unique_name
from cucumbervision.errors import CameraError, CaptureError, CucumberVisionError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping
    from pathlib import Path

    from cucumbervision.capture.frames import Capture, Stop
    from cucumbervision.capture.source import CaptureRef


class RgbdCamera(Protocol):
    """An RGB-D camera as a context manager.

    `realsense.RealSenseCamera` is one, `FolderCamera` another. A camera of another make needs
    these members and nothing else to be streamed and recorded from.
    """

    @property
    def device(self) -> Mapping[str, str]:
        """Description of the device: `camera`, `serial`, `firmware`."""

    def __enter__(self) -> Self:
        """Open the camera; raises `CameraError` if it is not available."""

    def __exit__(self, *error: object) -> None:
        """Close the camera."""

    def capture_burst(self, name: str | None = None, *, stop: Stop | None = None) -> Capture:
        """Return the next capture, depth aligned to colour, in metres.

        Raises
        ------
        CameraError
            If the camera sends no frame in time or is disconnected.
        CaptureError
            If this capture is invalid; the next one may be valid.
        """


def captures_of(
    open_camera: Callable[[], RgbdCamera],
    retries: int = 0,
    *,
    pause_s: float = 1.0,
    sleep: Callable[[float], None] = time.sleep,
) -> Generator[Capture | CaptureError]:
    """Yield the captures of a camera, and reconnect if it is disconnected.

    Parameters
    ----------
    open_camera : callable
        Creates the camera; called for each attempt.
    retries : int
        Maximum number of consecutive attempts to reconnect.
    pause_s : float
        Pause before each attempt, seconds.
    sleep : callable
        Function that waits.

    Yields
    ------
    Capture or CaptureError
        A capture, or the error of an invalid one.

    Raises
    ------
    CameraError
        If the camera cannot be opened or reconnected.
    """
    retries_left = retries
    while True:
        try:
            with open_camera() as camera:
                while True:
                    try:
                        capture: Capture | CaptureError = camera.capture_burst()
                        retries_left = retries
                    except CaptureError as error:
                        capture = error
                    yield capture
        except CameraError:
            if not retries_left:
                raise
            retries_left -= 1
            sleep(pause_s)


class FolderCamera:
    """A camera that reads captures which another program writes to a folder.

    Captures that exist when it is opened are skipped unless `old` is set. A capture is returned as
    soon as it can be read completely, or reported as an error when its files have not changed for
    `settle_s`; if they change later, it is read again. What leaves the folder is forgotten: another
    capture may come under its name.

    Parameters
    ----------
    folder : Path
        Folder for `capture.readers.open_source`; may be empty at first.
    options : ReadOptions, optional
        Intrinsics and depth unit.
    old : bool
        Also return existing captures.
    timeout_s : float
        Maximum time to wait for the next capture.
    settle_s : float
        Maximum pause while a capture is written.
    clock, sleep : callable
        Monotonic clock in seconds, and a function that waits.

    Examples
    --------
    >>> from cucumbervision.capture.source import example_captures
    >>> with FolderCamera(example_captures(), old=True) as camera:
    ...     camera.capture_burst().name
    'simulated-bench'
    """

    def __init__(
        self,
        folder: Path,
        options: ReadOptions | None = None,
        *,
        old: bool = False,
        timeout_s: float = 60.0,
        settle_s: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.device: dict[str, str] = {"camera": f"folder {folder.name}"}
        self._folder, self._options, self._old = folder, options or ReadOptions(), old
        self._timeout_s, self._settle_s = timeout_s, settle_s
        self._clock, self._sleep = clock, sleep
        self._taken: dict[str, str] = {}  # by the name in the folder, as what it was given
        # Unreadable captures: their files as last seen, since when, infinity once reported.
        self._unread: dict[str, tuple[object, float]] = {}

    def __enter__(self) -> Self:
        if not self._folder.is_dir():
            raise CameraError("there is no such folder", source=self._folder, remedy="make it")
        self._taken = {} if self._old else {ref.name: ref.name.casefold() for ref in self._refs()}
        return self

    def __exit__(self, *error: object) -> None:
        self._unread.clear()

    def capture_burst(self, name: str | None = None, *, stop: Stop | None = None) -> Capture:
        """Return the next new capture, in order of names.

        Raises
        ------
        CameraError
            If no capture appears in time.
        CaptureError
            If a capture remains unreadable; it is tried again when its files change.
        """
        until_s = self._clock() + self._timeout_s
        while True:
            began_s = self._clock()
            for ref in self._refs():
                capture = None if ref.name in self._taken else self._load(ref)
                if capture is None:
                    continue
                changes: dict[str, Any] = {"stop": stop} if stop is not None else {}
                given = {other for at, other in self._taken.items() if at != ref.name}
                capture_name = unique_name(name or capture.name, given)
                self._taken[ref.name] = capture_name.casefold()
                return replace(capture, name=capture_name, **changes)
            if self._clock() > until_s:
                raise CameraError(
                    f"no capture has appeared for {self._timeout_s:g} s",
                    source=self._folder,
                    remedy="check the program that writes them",
                )
            # Listing a large folder is slow: wait in proportion, so that most of the time is idle.
            self._sleep(max(_POLL_S, 4 * (self._clock() - began_s)))

    def _refs(self) -> list[CaptureRef]:
        try:
            refs = list(open_source(self._folder, self._options))
        except CucumberVisionError:
            return []  # still empty or incomplete, or out of reach for a moment
        there = {ref.name for ref in refs}
        for kept in (self._taken, self._unread):
            for name in kept.keys() - there:
                del kept[name]
        return refs

    def _load(self, ref: CaptureRef) -> Capture | None:
        """Return a complete capture; None while it may still be being written."""
        stamp, now_s = _stamp(ref), self._clock()
        before, since_s = self._unread.get(ref.name, (None, now_s))
        if stamp != before:
            since_s = now_s
        elif since_s == math.inf:
            return None
        try:
            capture = ref.load()
        except CucumberVisionError:
            is_late = now_s - since_s >= self._settle_s
            self._unread[ref.name] = stamp, math.inf if is_late else since_s
            if is_late:
                raise
            return None
        self._unread.pop(ref.name, None)
        return capture


def _stamp(ref: CaptureRef) -> object:
    """Return size and time of change of a capture's files, to be compared; None if unknown."""
    try:
        files = [part for part in (ref.parts() if ref.parts else ()) if not isinstance(part, bytes)]
        return [
            (str(file), stat.st_size, stat.st_mtime) for file in files for stat in [file.stat()]
        ]
    except (CucumberVisionError, OSError):
        return None


_POLL_S = 0.1
