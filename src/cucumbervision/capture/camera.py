"""What any RGB-D camera gives, of any make: captures, one after the other."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol, Self

from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.capture.source import unique_name
from cucumbervision.errors import CameraError, CaptureError, CucumberVisionError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Mapping
    from pathlib import Path

    from cucumbervision.capture.frames import Capture, Stop
    from cucumbervision.capture.source import CaptureRef


class RgbdCamera(Protocol):
    """A camera as a context manager: open between entering and leaving.

    `realsense.RealSenseCamera` is one, `FolderCamera` another. A camera of another make needs
    these members and nothing else to be streamed and recorded from.
    """

    @property
    def device(self) -> Mapping[str, str]:
        """What is known of it: `camera`, `serial`, `firmware`."""

    def __enter__(self) -> Self:
        """Open it; raises `CameraError` where there is none."""

    def __exit__(self, *error: object) -> None:
        """Close it, however the block ends."""

    def capture_burst(self, name: str | None = None, *, stop: Stop | None = None) -> Capture:
        """Return the next capture, depth aligned to colour, in metres.

        Raises
        ------
        CameraError
            If it sends nothing in time, or is gone.
        CaptureError
            If this capture is bad, which says nothing of the next.
        """


def captures_of(
    open_camera: Callable[[], RgbdCamera],
    retries: int = 0,
    *,
    pause_s: float = 1.0,
    sleep: Callable[[float], None] = time.sleep,
) -> Generator[Capture | CaptureError]:
    """Yield what a camera gives; one that is gone is opened again.

    Parameters
    ----------
    open_camera : callable
        Makes the camera, which is entered here; called again for each attempt.
    retries : int
        Attempts in a row to open it again; a capture sets the count back.
    pause_s : float
        How long to wait before each.
    sleep : callable
        How to wait.

    Yields
    ------
    Capture or CaptureError
        A capture, or why one is bad; the next may be good.

    Raises
    ------
    CameraError
        If the camera cannot be opened, or not again.
    """
    left = retries
    while True:
        try:
            with open_camera() as camera:
                while True:
                    try:
                        capture: Capture | CaptureError = camera.capture_burst()
                        left = retries
                    except CaptureError as error:
                        capture = error
                    yield capture
        except CameraError:
            if not left:
                raise
            left -= 1
            sleep(pause_s)


class FolderCamera:
    """A folder that fills: whatever program writes captures into it is the camera.

    Captures that lie there when it is opened are passed over, unless `old` asks for them. One is
    taken as soon as it can be read whole; one that still cannot be after `settle_s` is reported.

    Parameters
    ----------
    folder : Path
        As `capture.readers.open_source` takes it; may be empty at first.
    options : ReadOptions, optional
        What is said of the captures: intrinsics, depth unit.
    old : bool
        Whether captures that are there already are given too.
    timeout_s : float
        How long to wait for the next capture.
    settle_s : float
        How long a capture may take to be written.
    clock, sleep : callable
        Seconds that run on, and how to wait for some.

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
        self._taken: set[str] = set()
        self._names: set[str] = set()
        self._since_s: dict[str, float] = {}

    def __enter__(self) -> Self:
        if not self._folder.is_dir():
            raise CameraError("there is no such folder", source=self._folder, remedy="make it")
        self._taken = set() if self._old else {ref.name for ref in self._refs()}
        return self

    def __exit__(self, *error: object) -> None:
        self._since_s.clear()

    def capture_burst(self, name: str | None = None, *, stop: Stop | None = None) -> Capture:
        """Return the next capture that appears, by name where several are new.

        Raises
        ------
        CameraError
            If none appears in time.
        CaptureError
            If one stays broken; it is not tried again.
        """
        until_s = self._clock() + self._timeout_s
        while True:
            began_s = self._clock()
            for ref in self._refs():
                capture = None if ref.name in self._taken else self._load(ref)
                if capture is None:
                    continue
                given: dict[str, Any] = {"stop": stop} if stop is not None else {}
                own = unique_name(name or capture.name, self._names)
                return replace(capture, name=own, **given)
            if self._clock() > until_s:
                raise CameraError(
                    f"no capture has appeared for {self._timeout_s:g} s",
                    source=self._folder,
                    remedy="check the program that writes them",
                )
            # A folder of many captures takes a while to list: most of the time is left to others.
            self._sleep(max(_POLL_S, 4 * (self._clock() - began_s)))

    def _refs(self) -> Iterator[CaptureRef]:
        try:
            yield from open_source(self._folder, self._options)
        except CucumberVisionError:
            return  # nothing in it yet, or only the half of something

    def _load(self, ref: CaptureRef) -> Capture | None:
        """Return a capture that is whole; None while it may still be written."""
        now_s = self._clock()
        try:
            capture = ref.load()
        except CucumberVisionError:
            if now_s - self._since_s.setdefault(ref.name, now_s) < self._settle_s:
                return None
            self._taken.add(ref.name)
            raise
        self._taken.add(ref.name)
        self._since_s.pop(ref.name, None)
        return capture


_POLL_S = 0.1
