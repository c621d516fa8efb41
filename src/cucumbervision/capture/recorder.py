"""Record captures of a live camera to folders, one per trigger."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from cucumbervision.capture.camera import captures_of
from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.quality import depth_quality
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import safe_name
from cucumbervision.errors import CucumberVisionError, named_error

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from cucumbervision.capture.camera import RgbdCamera
    from cucumbervision.capture.quality import DepthQuality


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
