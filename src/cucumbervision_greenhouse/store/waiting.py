"""The queue of captures to measure, written to disk atomically when they are taken.

Each is a native capture folder with a file `waiting.json` that names its future stop and round. It
is written under a temporary name, flushed to the disk and then renamed, so that a killed program
leaves no partial capture.
"""

from __future__ import annotations

import json
import os
import shutil
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from pydantic import FiniteFloat, TypeAdapter

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.readers.native import read_native, write_native
from cucumbervision.errors import StoreError, wrap_os_errors
from cucumbervision.files import sync_folder

MOST_TRIES = 3  # limits how often a capture can crash the program

_DESCRIPTION_FILE = "waiting.json"
_TRIES_FILE = "tries"
_TEMPORARY = ".unfinished-"
_REMEDY = "free some space on the disk, and check its rights"


@dataclass(frozen=True)
class Waiting:
    """A capture in the queue.

    Parameters
    ----------
    key, round_key : str
        Of the stop that it will be, and of the stop's round.
    stop : Stop
        Where it was taken.
    pressed_s : float
        When, seconds since 1970 (UTC).
    folder : Path
        Where it lies.
    source : str
        What it was taken from.
    tries : int
        Number of measurements that were started and not finished.
    """

    key: str
    round_key: str
    stop: Stop
    pressed_s: FiniteFloat
    folder: Path
    source: str = ""
    tries: int = 0

    def load(self) -> Capture:
        """Return the capture as it was kept.

        Raises
        ------
        CaptureError
            If it was damaged since.
        """
        capture = read_native(self.folder)
        return replace(capture, source=self.source or capture.source)


def waiting_folder(store: str) -> Path:
    """Return the folder of a store's queue: beside an SQLite file, otherwise in the user's folder.

    Examples
    --------
    >>> waiting_folder("house.db").name
    'house.waiting'
    """
    if "://" not in store:
        return Path(store).with_suffix(".waiting")
    import platformdirs

    return Path(platformdirs.user_data_dir("cucumbervision", appauthor=False)) / "waiting"


class WaitingCaptures:
    """A folder of captures to measure, in the order in which they were taken.

    Parameters
    ----------
    folder : Path
        Made with the first capture.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> import numpy as np
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision_greenhouse.store.records import key_of
    >>> depth, color = np.full((48, 64), 0.5, np.float32), np.zeros((48, 64, 3), np.uint8)
    >>> capture = Capture(color, depth, Intrinsics(64, 48, 60, 60, 32, 24), "a", stop=Stop("3"))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     queue = WaitingCaptures(pathlib.Path(folder) / "house.waiting")
    ...     queued = queue.put(capture, key_of("stop"), key_of("round"), 1_700_000_000.0)
    ...     [waiting] = queue.captures()
    ...     print(waiting == queued, waiting.stop.row, waiting.load().name)
    ...     queue.done(waiting)
    ...     queue.captures()
    True 3 a
    []
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._read: dict[Path, Waiting] = {}

    def put(self, capture: Capture, key: str, round_key: str, pressed_s: float) -> Waiting:
        """Save a capture durably, so that it survives a kill or a power failure after this returns.

        Raises
        ------
        StoreError, CaptureError
            If it cannot be written; nothing is left behind.
        """
        folder = self.folder / f"{round(1e6 * pressed_s):016d}-{key}"
        half = self.folder / f"{_TEMPORARY}{folder.name}"
        description = {"key": key, "round": round_key, "pressed_s": pressed_s}
        description |= {"stop": asdict(capture.stop), "source": capture.source}
        try:
            with wrap_os_errors("cannot be written", self.folder, _REMEDY, StoreError):
                half.mkdir(parents=True)
                write_native(capture, half)
                (half / _DESCRIPTION_FILE).write_text(json.dumps(description), encoding="utf-8")
                _sync(half)
                half.rename(folder)
                sync_folder(self.folder)
        except BaseException:
            shutil.rmtree(half, ignore_errors=True)
            raise
        return Waiting(key, round_key, capture.stop, pressed_s, folder, capture.source)

    def captures(self) -> list[Waiting]:
        """Return the queued captures, the oldest first, without those that failed too often."""
        return [queued for queued in self._all() if queued.tries < MOST_TRIES]

    def set_aside(self) -> list[Waiting]:
        """Return the captures that failed too often; they are kept for inspection."""
        return [queued for queued in self._all() if queued.tries >= MOST_TRIES]

    def holds(self, key: str) -> bool:
        """Return whether a capture of this key waits, or was set aside."""
        return any(self.folder.glob(f"[0-9]*-{key}/{_DESCRIPTION_FILE}"))

    def begin(self, queued_capture: Waiting) -> None:
        """Record the start of a measurement, to recognise captures that crash the program.

        Raises
        ------
        DiskFullError
            If the disk is full.
        """
        path = queued_capture.folder / _TRIES_FILE
        with (
            wrap_os_errors("cannot be written", path, _REMEDY, StoreError),
            path.open("ab") as tries,
        ):
            tries.write(b".")
            tries.flush()
            os.fsync(tries.fileno())

    def forget_start(self, queued_capture: Waiting) -> None:
        """Take back what `begin` recorded: that it was not measured is no fault of the capture."""
        path = queued_capture.folder / _TRIES_FILE
        with suppress(OSError):
            os.truncate(path, max(path.stat().st_size - 1, 0))

    def done(self, queued_capture: Waiting) -> None:
        """Remove a capture whose stop is in the store."""
        half = queued_capture.folder.with_name(f"{_TEMPORARY}{queued_capture.folder.name}")
        with suppress(FileNotFoundError):
            queued_capture.folder.rename(half)
        shutil.rmtree(half, ignore_errors=True)

    def clean(self) -> None:
        """Remove partial folders of a killed program; call it at the start."""
        for half in self.folder.glob(f"{_TEMPORARY}*"):
            shutil.rmtree(half, ignore_errors=True)

    def _all(self) -> list[Waiting]:
        queue, read_before = [], self._read
        for path in sorted(self.folder.glob(f"[0-9]*/{_DESCRIPTION_FILE}")):
            # Another thread may have removed it, and a damaged one must not hold up the others.
            with suppress(Exception):
                queued, tries = read_before.get(path) or _read(path), path.with_name(_TRIES_FILE)
                queue.append(replace(queued, tries=tries.stat().st_size if tries.exists() else 0))
        self._read = {queued.folder / _DESCRIPTION_FILE: queued for queued in queue}
        return queue


def _read(path: Path) -> Waiting:
    values = json.loads(path.read_text(encoding="utf-8"))
    values |= {"round_key": values.pop("round"), "stop": Stop(**values["stop"])}
    return TypeAdapter(Waiting).validate_python({**values, "folder": path.parent})


def _sync(folder: Path) -> None:
    """Flush a folder and its content to the disk."""
    for path in (*folder.rglob("*"), folder):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
