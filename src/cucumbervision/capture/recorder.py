"""Captures from a live camera into folders: one at each signal, each whole or not at all."""

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
    """Where captures are taken: the first place, and how far it is to the next.

    Parameters
    ----------
    row, side : str, optional
        Row in the house, and its side.
    position_m : float, optional
        Of the first capture along the row.
    step_m : float
        From one to the next.

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
        """Return the place of a capture, counted from 0."""
        at_m = None if self.position_m is None else round(self.position_m + number * self.step_m, 4)
        return Stop(self.row, self.side, at_m, number + 1)


@dataclass(frozen=True, eq=False)
class Recorded:
    """A capture that was written.

    Parameters
    ----------
    capture : Capture
        As it was written.
    path : Path
        Its `capture.json`.
    quality : DepthQuality
        How good its depth is, and what to do better.
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
    """Write a capture at each signal.

    A camera that is gone is opened again, and the capture then taken. A capture's `capture.json`
    is written last: one that breaks off is none, and its number is not used again.

    Parameters
    ----------
    open_camera : callable
        Makes the camera; it is open from the first signal on.
    out : Path
        Gets a folder a capture, `NAME_0001` and so on after the last that is there.
    signals : iterable
        When to take one: a key, a clock, a trigger of a robot. The recording ends with them.
    walk : Walk, optional
        Where they are taken.
    name : str
        What the captures are called.
    retries : int
        How often in a row a camera that is gone is opened again.

    Yields
    ------
    Recorded or CucumberVisionError
        What was written, or why a capture was not; the next is tried all the same.

    Raises
    ------
    CameraError
        If there is no camera, or it does not come back.
    """
    walk, name = walk or Walk(), safe_name(name)
    number, taken = _last_number(out, name), 0
    captures = captures_of(open_camera, retries)
    try:
        for _ in signals:
            number += 1
            given = next(captures)
            if not isinstance(given, Capture):
                yield given
                continue
            own = f"{name}_{number:04d}"
            try:
                capture = replace(given, name=own, stop=walk.stop(taken))
                path = write_native(capture, out / own)
            except (CucumberVisionError, OSError) as error:
                yield named_error(error, out / own)
                continue
            taken += 1
            yield Recorded(capture, path, depth_quality(capture))
    finally:
        captures.close()


def _last_number(out: Path, name: str) -> int:
    numbers = [one.name.removeprefix(f"{name}_") for one in out.glob(f"{name}_*")]
    return max((int(text) for text in numbers if text.isdecimal()), default=0)
