"""`open_source` for who does not trust a recording: it is played in a limited process."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, safe_name
from cucumbervision.intake.recordings import play_apart

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cucumbervision.capture.frames import Capture
    from cucumbervision.errors import CucumberVisionError
    from cucumbervision.intake.limits import RecordingLimits

__all__ = ["open_guarded"]

_RECORDINGS = frozenset({".bag", ".db3"})


def open_guarded(
    path: Path | str, options: ReadOptions | None = None, limits: RecordingLimits | None = None
) -> CaptureSource:
    """Open whatever holds captures; recordings are played in a limited process.

    Parameters
    ----------
    path : Path or str
        As for `open_source`.
    options : ReadOptions, optional
        As for `open_source`.
    limits : RecordingLimits, optional
        What the process may use.

    Returns
    -------
    CaptureSource
        The same captures as `open_source` gives. A recording is played when it is iterated, all of
        it before the first capture comes; what it writes is gone when the iteration ends.

    Raises
    ------
    CucumberVisionError
        As `open_source`.
    """
    path, options = Path(path), options or ReadOptions()
    if not path.is_file() or path.suffix.lower() not in _RECORDINGS:
        return open_source(path, options)
    return CaptureSource(path, "recording", lambda: _refs(path, options, limits))


def _refs(path: Path, options: ReadOptions, limits: RecordingLimits | None) -> Iterator[CaptureRef]:
    name = safe_name(path.stem)
    with tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
        out = Path(folder) / "captures"
        played = play_apart(path, out, limits, burst=options.burst, name=name)
        if played.captures:
            for ref in open_source(out, replace(options, depth_unit_m=None)):
                yield CaptureRef(ref.name, ref.frame, partial(_load, ref, path))
        for error in played.errors:
            # What came before a break is whole; the break itself is a capture that fails.
            yield CaptureRef(f"{name}_end", -1, partial(_fail, error))


def _load(ref: CaptureRef, path: Path) -> Capture:
    return replace(ref.load(), source=str(path))


def _fail(error: CucumberVisionError) -> Capture:
    raise error
