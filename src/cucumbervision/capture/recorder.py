"""Record captures of a live camera to folders, one per trigger, and assess their depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.camera import captures_of
from cucumbervision.capture.frames import Capture, Stop, still_px, valid_depth
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import safe_name
from cucumbervision.errors import CucumberVisionError, named_error

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from cucumbervision.capture.camera import RgbdCamera


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
        Share of valid readings in the centre of the picture, 0 to 1.
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
    """Return the depth quality of a frame from its centre and the motion of the picture.

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
    middle = capture.depth_m[
        height // 6 : height - height // 6 : _STRIDE, width // 6 : width - width // 6 : _STRIDE
    ]
    valid = middle[valid_depth(middle)]
    fill = valid.size / middle.size
    if not valid.size:
        return DepthQuality(0.0, None, "none", "No depth: too near, or the lens is covered")
    distance_m = float(np.quantile(valid, NEAREST / 2))
    if distance_m < _NEAR_M:
        return DepthQuality(fill, distance_m, "too-near", "Too near: step back")
    if distance_m > _FAR_M:
        return DepthQuality(fill, distance_m, "too-far", "Too far: step closer")
    if capture.moved_px > still_px(capture.color):
        return DepthQuality(fill, distance_m, "moving", "The camera moves: hold still")
    if fill < _POOR_FILL:
        return DepthQuality(fill, distance_m, "poor", "Many holes: avoid glare, hold still")
    return DepthQuality(fill, distance_m, "good", "Good distance and depth")
