"""Interface of RGB-D cameras of any make, and a camera that watches a folder."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from cucumbervision.capture.frames import Capture, Stop, still_px, valid_depth
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import CaptureRef, safe_name, unique_name
from cucumbervision.errors import CameraError, CaptureError, CucumberVisionError, named_error


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
                taken = {key for file, key in self._taken.items() if file != ref.name}
                capture_name = unique_name(name or capture.name, taken)
                self._taken[ref.name] = capture_name.casefold()
                return replace(capture, name=capture_name, **changes)
            if self._clock() > until_s:
                fault = f"no capture has appeared for {self._timeout_s:g} s"
                remedy = "check the program that writes them"
                raise CameraError(fault, source=self._folder, remedy=remedy)
            # Listing a large folder is slow: wait in proportion, so that most of the time is idle.
            self._sleep(max(_POLL_S, 4 * (self._clock() - began_s)))

    def _refs(self) -> list[CaptureRef]:
        try:
            refs = list(open_source(self._folder, self._options))
        except CucumberVisionError:
            return []  # still empty or incomplete, or out of reach for a moment
        for names in (self._taken, self._unread):
            for name in names.keys() - {ref.name for ref in refs}:
                del names[name]
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
        return [(str(file), (s := file.stat()).st_size, s.st_mtime) for file in files]
    except (CucumberVisionError, OSError):
        return None


_POLL_S = 0.1


@dataclass(frozen=True)
class Walk:
    """Positions of consecutive captures along a row.

    Parameters
    ----------
    row, side : str, optional
        Row in the greenhouse, and its side.
    position_m : float, optional
        Position of the first capture along the row.
    step_m : float
        Distance between captures.

    Examples
    --------
    >>> Walk("3", "left", 1.0, 0.4).stop(2)
    Stop(row='3', side='left', position_m=1.8, step=3)
    """

    row: str | None = None
    side: str | None = None
    position_m: float | None = None
    step_m: float = 0.0

    def stop(self, number: int) -> Stop:
        """Return the position of a capture, counted from 0."""
        at_m = None if self.position_m is None else round(self.position_m + number * self.step_m, 4)
        return Stop(self.row, self.side, at_m, number + 1)


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recorded capture.

    Parameters
    ----------
    capture : Capture
        The capture.
    path : Path
        Its `capture.json`.
    quality : DepthQuality
        Its depth quality with advice.
    """

    capture: Capture
    path: Path
    quality: DepthQuality


def record_captures(
    open_camera: Callable[[], RgbdCamera],
    out: Path,
    signals: Iterable[object],
    walk: Walk | None = None,
    *,
    name: str = "capture",
    retries: int = 0,
) -> Iterator[Recorded | CucumberVisionError]:
    """Record a capture for each trigger signal.

    A disconnected camera is reconnected before the capture is taken. `capture.json` is written
    last, so an interrupted write leaves no capture; its number is not reused.

    Parameters
    ----------
    open_camera : callable
        Creates the camera, which is opened at the first signal.
    out : Path
        Folder for the captures, numbered `NAME_0001` and so on after existing ones.
    signals : iterable
        Trigger signals, such as keys, a clock or a robot. The recording ends with them.
    walk : Walk, optional
        Positions of the captures.
    name : str
        Base name of the captures.
    retries : int
        Maximum number of consecutive attempts to reconnect.

    Yields
    ------
    Recorded or CucumberVisionError
        A recorded capture, or the error of a failed one, after which recording continues.

    Raises
    ------
    CameraError
        If the camera is not available or cannot be reconnected.
    """
    walk, name = walk or Walk(), safe_name(name)
    number, taken = _last_number(out, name), 0
    captures = captures_of(open_camera, retries)
    try:
        for _ in signals:
            number += 1
            capture = next(captures)
            if not isinstance(capture, Capture):
                yield capture
                continue
            capture_name = f"{name}_{number:04d}"
            try:
                capture = replace(capture, name=capture_name, stop=walk.stop(taken))
                path = write_native(capture, out / capture_name)
            except (CucumberVisionError, OSError) as error:
                yield named_error(error, out / capture_name)
                continue
            taken += 1
            yield Recorded(capture, path, depth_quality(capture))
    finally:
        captures.close()


def _last_number(out: Path, name: str) -> int:
    numbers = [path.name.removeprefix(f"{name}_") for path in out.glob(f"{name}_*")]
    return max((int(text) for text in numbers if text.isdecimal()), default=0)


_NEAR_M, _FAR_M = 0.30, 1.00  # a D435 sees nothing under 0.28 m at 1280x720; noise grows as z²
_POOR_FILL = 0.60
NEAREST = 0.10
_STRIDE = 4


@dataclass(frozen=True)
class DepthQuality:
    """Quality of a frame's depth.

    Parameters
    ----------
    fill : float
        Share of valid readings in the centre of the image, 0 to 1.
    distance_m : float, optional
        Distance of the nearest tenth of the centre, that is of the fruit, not the background.
    verdict : str
        'good', 'too-near', 'too-far', 'moving', 'poor' or 'none'.
    advice : str
        Advice to the operator.
    """

    fill: float
    distance_m: float | None
    verdict: str
    advice: str


def depth_quality(capture: Capture) -> DepthQuality:
    """Return the depth quality of a frame from its centre and the motion of the image.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    >>> def at(z):
    ...     color = np.zeros((48, 64, 3), np.uint8)
    ...     return depth_quality(Capture(color, np.full((48, 64), z, np.float32), camera, "a"))
    >>> at(0.5).verdict, at(0.2).verdict, at(1.4).verdict, at(0.0).verdict
    ('good', 'too-near', 'too-far', 'none')
    """
    height, width = capture.depth_m.shape
    rows, columns = (slice(n // 6, n - n // 6, _STRIDE) for n in (height, width))
    middle = capture.depth_m[rows, columns]
    valid = middle[valid_depth(middle)]
    if not valid.size:
        return DepthQuality(0.0, None, "none", "No depth: too near, or the lens is covered")
    fill, distance_m = valid.size / middle.size, float(np.quantile(valid, NEAREST / 2))
    verdicts = (
        (distance_m < _NEAR_M, "too-near", "Too near: step back"),
        (distance_m > _FAR_M, "too-far", "Too far: step closer"),
        (capture.moved_px > still_px(capture.color), "moving", "The camera moves: hold still"),
        (fill < _POOR_FILL, "poor", "Many holes: avoid glare, hold still"),
        (True, "good", "Good distance and depth"),
    )
    verdict, advice = next(words for is_so, *words in verdicts if is_so)
    return DepthQuality(fill, distance_m, verdict, advice)
