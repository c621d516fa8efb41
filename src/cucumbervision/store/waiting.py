"""Captures that wait to be measured: kept on disk the moment they are taken, whole or not at all.

Each is a native capture folder, so that anything that reads captures can read it, with a file
`waiting.json` that says which stop of which round it will be. It is written under a temporary name,
brought to the disk and only then given its own name: what a kill leaves half done is no capture.
"""

from __future__ import annotations

import json
import os
import shutil
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.capture.files import sync_folder
from cucumbervision.capture.frames import Stop
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.errors import StoreError, wrap_os_errors

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Capture

MOST_TRIES = 3  # a capture that ends the program each time must not do so for ever

_WHERE = "waiting.json"
_TRIES = "tries"
_TEMPORARY = ".unfinished-"


@dataclass(frozen=True)
class Waiting:
    """A capture that waits.

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
        How often its measuring was begun and not ended.
    """

    key: str
    round_key: str
    stop: Stop
    pressed_s: float
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
        capture = next(iter(open_source(self.folder))).load()
        return replace(capture, source=self.source)


def waiting_folder(store: str) -> Path:
    """Return where a store's captures wait: beside an SQLite file, else the user's own folder.

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
    """A folder of captures that wait, in the order in which they were taken.

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
    >>> from cucumbervision.store.records import key_of
    >>> depth, color = np.full((48, 64), 0.5, np.float32), np.zeros((48, 64, 3), np.uint8)
    >>> capture = Capture(color, depth, Intrinsics(64, 48, 60, 60, 32, 24), "a", stop=Stop("3"))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     queue = WaitingCaptures(pathlib.Path(folder) / "house.waiting")
    ...     kept = queue.put(capture, key_of("stop"), key_of("round"), 1_700_000_000.0)
    ...     [one] = queue.captures()
    ...     print(one == kept, one.stop.row, one.load().name)
    ...     queue.done(one)
    ...     queue.captures()
    True 3 a
    []
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._read: dict[Path, Waiting] = {}

    def put(self, capture: Capture, key: str, round_key: str, pressed_s: float) -> Waiting:
        """Keep a capture; when this returns, no kill and no power cut takes it away.

        Raises
        ------
        StoreError, CaptureError
            If it cannot be written; nothing is left behind.
        """
        name = f"{round(1e6 * pressed_s):016d}-{key}"
        one = Waiting(key, round_key, capture.stop, pressed_s, self.folder / name, capture.source)
        half = self.folder / f"{_TEMPORARY}{name}"
        about = {
            "key": key,
            "round": round_key,
            "pressed_s": pressed_s,
            "stop": asdict(capture.stop),
            "source": capture.source,
        }
        remedy = "free some space on the disk, and check its rights"
        try:
            with wrap_os_errors("cannot be written", self.folder, remedy, StoreError):
                half.mkdir(parents=True)
                write_native(capture, half)
                (half / _WHERE).write_text(json.dumps(about), encoding="utf-8")
                _sync(half)
                half.rename(one.folder)
                sync_folder(self.folder)
        except BaseException:
            shutil.rmtree(half, ignore_errors=True)
            raise
        return one

    def captures(self) -> list[Waiting]:
        """Return what waits, the oldest first; what has failed too often is left out."""
        return [one for one in self._all() if one.tries < MOST_TRIES]

    def set_aside(self) -> list[Waiting]:
        """Return what was tried too often: it stays where it is, for somebody to look at."""
        return [one for one in self._all() if one.tries >= MOST_TRIES]

    def holds(self, key: str) -> bool:
        """Return whether a capture of this key waits, or was set aside."""
        return any(self.folder.glob(f"[0-9]*-{key}/{_WHERE}"))

    def begin(self, one: Waiting) -> None:
        """Note that measuring begins, so that a capture that ends the program is known."""
        with (one.folder / _TRIES).open("ab") as tries:
            tries.write(b".")
            tries.flush()
            os.fsync(tries.fileno())

    def done(self, one: Waiting) -> None:
        """Remove a capture whose stop is in the store."""
        half = one.folder.with_name(f"{_TEMPORARY}{one.folder.name}")
        with suppress(FileNotFoundError):
            one.folder.rename(half)
        shutil.rmtree(half, ignore_errors=True)

    def clean(self) -> None:
        """Remove what a kill left half written or half removed; when a program starts."""
        for half in self.folder.glob(f"{_TEMPORARY}*"):
            shutil.rmtree(half, ignore_errors=True)

    def _all(self) -> list[Waiting]:
        found, known = [], self._read
        for path in sorted(self.folder.glob(f"[0-9]*/{_WHERE}")):
            # Another thread may just be done with it.
            with suppress(OSError, ValueError, KeyError, TypeError):
                one, tries = known.get(path) or _read(path), path.with_name(_TRIES)
                found.append(replace(one, tries=tries.stat().st_size if tries.exists() else 0))
        self._read = {one.folder / _WHERE: one for one in found}
        return found


def _read(path: Path) -> Waiting:
    about = json.loads(path.read_text(encoding="utf-8"))
    stop = Stop(**about["stop"])
    place = about["key"], about["round"], stop, about["pressed_s"]
    return Waiting(*place, path.parent, about["source"])


def _sync(folder: Path) -> None:
    """Bring a folder and all that is in it to the disk."""
    for path in sorted(folder.rglob("*")):
        if path.is_dir():
            sync_folder(path)
        else:
            handle = os.open(path, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
    sync_folder(folder)
