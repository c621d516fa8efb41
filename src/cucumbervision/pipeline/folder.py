"""An output folder with atomic files, and the journal of finished captures.

The journal is a folder `journal/` of segments, each written by one run. A line is a checksum, the
place of the capture and the record as JSON; the last complete line of a place is its record. A
partial line of a killed program is ignored; its capture is measured again.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import tempfile
import time
import uuid
import zlib
from collections import OrderedDict
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from cucumbervision.errors import CucumberVisionError, wrap_os_errors
from cucumbervision.files import sync_folder
from cucumbervision.pipeline.measurer import Failure
from cucumbervision.urls import is_remote, with_retries

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from typing import Self

    from cucumbervision.pipeline.fields import Cell


class OutputFolder:
    """A local folder, or one on a store that fsspec supports.

    Files are replaced atomically. When `write` and `replacing` return, the content is on disk (or
    acknowledged by the store).

    Parameters
    ----------
    path : Path
        Location, as `as_path` returns it.

    Examples
    --------
    >>> out = OutputFolder(Path(tempfile.mkdtemp()))
    >>> out.write("overlays/a.png", b"picture")
    >>> out.has("overlays/a.png"), (out.path / "overlays/a.png").read_bytes()
    (True, b'picture')
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_remote = is_remote(path)
        self._unfinished = path / ".unfinished"

    def has(self, name: str) -> bool:
        """Return whether a file of that name exists."""
        return with_retries(self.path, (self.path / name).exists)

    def write(self, name: str, data: bytes) -> None:
        """Write a file.

        Raises
        ------
        OSError
            If it cannot be written; what was there before is still there.
        """
        if self.is_remote:
            target = self.path / name
            with_retries(target, lambda: target.write_bytes(data))
            return
        with self.replacing(name) as path:
            path.write_bytes(data)

    @contextmanager
    def replacing(self, name: str) -> Iterator[Path]:
        """Yield a local temporary file, which replaces the named file when the block succeeds.

        Raises
        ------
        OSError
            If it cannot be written; what was there before is still there.
        """
        if self.is_remote:
            with tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
                filled = Path(folder) / Path(name).name
                yield filled
                self._upload(filled, name)
            return
        target = self.path / name
        for place in (target.parent, self._unfinished):
            place.mkdir(parents=True, exist_ok=True)
        # Writers recognise the format by the extension.
        filled = self._unfinished / f"{uuid.uuid4().hex}{target.suffix}"
        try:
            yield filled
            with filled.open("rb+") as file:
                os.fsync(file.fileno())
            filled.replace(target)
        finally:
            with suppress(OSError):
                filled.unlink(missing_ok=True)
        sync_folder(target.parent)

    def _upload(self, filled: Path, name: str) -> None:
        target: Any = self.path / name
        with_retries(target, lambda: target.fs.put_file(str(filled), target.path))

    @contextmanager
    def locked(self, name: str) -> Iterator[None]:
        """Lock the folder against other programs during the block, if the system can lock files.

        What killed programs left half written is removed.

        Raises
        ------
        CucumberVisionError
            If another program has locked it.
        """
        try:
            import fcntl
        except ModuleNotFoundError:  # Windows
            yield
            return
        if self.is_remote:
            yield
            return
        with wrap_os_errors("cannot be written", self.path):
            (self.path / name).parent.mkdir(parents=True, exist_ok=True)
            file = (self.path / name).open("a")
        with file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise CucumberVisionError(
                    "another run is writing into it",
                    source=self.path,
                    remedy="wait until it ends, or choose another --out",
                ) from None
            shutil.rmtree(self._unfinished, ignore_errors=True)
            try:
                yield
            finally:
                with suppress(OSError):
                    self._unfinished.rmdir()


JOURNAL = "journal"

_SEGMENT_HEAD = b'{"format": "cucumbervision-journal", "version": 1}\n'
_CHECKSUM_DIGITS, _PLACE_DIGITS = 8, 32  # hexadecimal digits
_RECORD_START = _CHECKSUM_DIGITS + 1 + _PLACE_DIGITS + 1

# A remote store takes whole objects: records are collected for at most this number or time.
_BATCH_RECORDS, _BATCH_S = 256, 30.0
_SEGMENTS_HELD = 8


def place_of(address: str, name: str) -> str:
    """Return the journal key of a capture: a hash of its location and its name in the tables.

    Examples
    --------
    >>> len(place_of("house/a/capture.json", "a"))
    32
    """
    return hashlib.blake2b(
        json.dumps([address, name]).encode(), digest_size=_PLACE_DIGITS // 2
    ).hexdigest()


BESIDE_CELLS = frozenset({"pose", "methods"})
"""Keys of a fruit of `measurements.json` beside the cells of its row."""


@dataclass(frozen=True, kw_only=True)
class JournalRecord:
    """The journal's record of one measured capture.

    Parameters
    ----------
    place : str
        Key from `place_of`.
    content : str
        Hash of the files that it was read from.
    stages : tuple of str
        Processing stages of its fruit, as in `Stage`.
    digest : str
        Hash of the options and networks of those stages.
    capture : dict
        The capture with its fruit, as in `measurements.json`.
    failures : tuple of Failure
        Rejected instances, and files that could not be written.
    models : list of dict
        The networks that were used.
    picture : str, optional
        Its annotated picture in the output folder; empty if none was asked for, None if it could
        not be written, so that the capture counts as incomplete.
    """

    place: str
    content: str
    stages: tuple[str, ...]
    digest: str
    capture: dict[str, Any]
    failures: tuple[Failure, ...]
    models: list[dict[str, Any]]
    picture: str | None

    @property
    def rows(self) -> list[dict[str, Cell]]:
        """The rows of the table of fruit."""
        return [
            {name: cell for name, cell in fruit.items() if name not in BESIDE_CELLS}
            for fruit in self.capture["fruit"]
        ]

    def line(self) -> bytes:
        """Return the record as a line of the journal."""
        values = {**vars(self), "failures": [vars(failure) for failure in self.failures]}
        del values["place"]
        body = f"{self.place} {json.dumps(values, separators=(',', ':'))}".encode()
        return b"%08x %b\n" % (zlib.crc32(body), body)

    @classmethod
    def from_line(cls, line: bytes) -> JournalRecord:
        """Return the record of a line that passed `_is_whole`."""
        values = json.loads(line[_RECORD_START:])
        values["failures"] = tuple(Failure(**failure) for failure in values["failures"])
        values["stages"] = tuple(values["stages"])
        return cls(place=line[_CHECKSUM_DIGITS + 1 : _RECORD_START - 1].decode(), **values)


def _is_whole(line: bytes) -> bool:
    """Return whether a line is a complete record with a correct checksum."""
    if (
        len(line) <= _RECORD_START
        or not line.endswith(b"\n")
        or line[_CHECKSUM_DIGITS : _CHECKSUM_DIGITS + 1] != b" "
    ):
        return False
    return line[:_CHECKSUM_DIGITS] == b"%08x" % zlib.crc32(line[_CHECKSUM_DIGITS + 1 : -1])


class Journal:
    """The records of an output folder, by place.

    Parameters
    ----------
    out : OutputFolder
        The output folder. The segments in `journal/` are indexed once, and not kept in memory.

    Raises
    ------
    CucumberVisionError
        If they cannot be read, or a new segment cannot be created.
    """

    def __init__(self, out: OutputFolder) -> None:
        self._out = out
        self._folder = out.path / JOURNAL
        self._index: dict[bytes, tuple[int, int, int]] = {}
        self._held: OrderedDict[int, bytes] = OrderedDict()
        self._waiting: list[JournalRecord] = []
        self._since = time.monotonic()
        self._file: BinaryIO | None = None
        self._torn = False
        self.damaged = 0
        with wrap_os_errors("cannot be read", self._folder, "check who may read it"):
            segments = self._folder.glob("*.jsonl") if self._folder.exists() else ()
            self._segments = sorted(segments, key=lambda path: path.name)
            for number in range(len(self._segments)):
                self._look_through(number)
        # A file of another name may have been put there.
        numbers = [re.match("[0-9]{1,12}", path.name) for path in self._segments]
        last = max((int(number[0]) for number in numbers if number), default=0)
        # The name includes the run: on a remote store, nothing locks out a second run.
        self._run = f"{last + 1:06d}-{uuid.uuid4().hex[:8]}"
        self._number = 0
        self._begin()

    def __len__(self) -> int:
        return len(self._index)

    def _look_through(self, number: int) -> None:
        offset = 0
        with self._segments[number].open("rb") as file:
            for line in file:
                if _is_whole(line):
                    self._index[_key(line)] = number, offset, len(line)
                elif line.strip() and not line.startswith(b"{"):
                    self.damaged += 1
                offset += len(line)

    def _begin(self) -> None:
        with wrap_os_errors("cannot be written", self._out.path):
            if self._out.is_remote:  # reports immediately if the store is read-only
                self._out.write(f"{JOURNAL}/{self._run}-.jsonl", _SEGMENT_HEAD)
                return
            self._folder.mkdir(parents=True, exist_ok=True)
            path = self._folder / f"{self._run}.jsonl"
            # Unbuffered: bytes that a full disk rejects must not be written with the next record.
            self._file = path.open("xb", buffering=0)
            self._file.write(_SEGMENT_HEAD)
            os.fsync(self._file.fileno())
            sync_folder(self._folder)
        self._segments.append(path)

    def find(self, place: str) -> JournalRecord | None:
        """Return the record of a place, if there is one."""
        if self._waiting:
            self.flush()
        where = self._index.get(bytes.fromhex(place))
        if where is None:
            return None
        number, offset, length = where
        if self._out.is_remote:
            return JournalRecord.from_line(self._segment(number)[offset : offset + length])
        with self._segments[number].open("rb") as file:
            file.seek(offset)
            return JournalRecord.from_line(file.read(length))

    def _segment(self, number: int) -> bytes:
        """Return a whole segment of a remote store, because the next record is usually in it."""
        if number not in self._held:
            segment = self._segments[number]
            self._held[number] = with_retries(segment, segment.read_bytes)
            if len(self._held) > _SEGMENTS_HELD:
                self._held.popitem(last=False)
        self._held.move_to_end(number)
        return self._held[number]

    def records(self, places: Iterable[str]) -> Iterator[JournalRecord]:
        """Yield the records of places that have one, in that order."""
        for place in places:
            record = self.find(place)
            if record is not None:
                yield record

    def append(self, record: JournalRecord) -> None:
        """Add a record. In a local folder it is on disk when this method returns.

        For a remote store, records are collected for up to half a minute: if the run is killed,
        the captures of unsent records are measured again.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        if self._file is None:
            self._waiting.append(record)
            if len(self._waiting) >= _BATCH_RECORDS or time.monotonic() - self._since > _BATCH_S:
                self.flush()
            return
        # The newline ends a partial line of an earlier attempt, which is no record.
        line = b"\n" * self._torn + record.line()
        self._torn = True
        unwritten, offset = memoryview(line), self._file.tell()
        while unwritten:
            unwritten = unwritten[self._file.write(unwritten) or 0 :]
        os.fsync(self._file.fileno())
        self._torn = False
        offset += len(line) - len(record.line())
        self._index[bytes.fromhex(record.place)] = (
            len(self._segments) - 1,
            offset,
            len(record.line()),
        )

    def flush(self) -> None:
        """Write the collected records.

        Raises
        ------
        OSError
            If they cannot be written; they are kept for the next attempt.
        """
        if not self._waiting:
            return
        lines = [record.line() for record in self._waiting]
        name = f"{self._run}-{self._number:06d}.jsonl"
        self._out.write(f"{JOURNAL}/{name}", _SEGMENT_HEAD + b"".join(lines))
        self._segments.append(self._folder / name)
        offset = len(_SEGMENT_HEAD)
        for line in lines:
            self._index[_key(line)] = len(self._segments) - 1, offset, len(line)
            offset += len(line)
        self._waiting, self._since, self._number = [], time.monotonic(), self._number + 1

    def close(self) -> None:
        """End this run's segment; records can still be read."""
        if self._file is not None:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _key(line: bytes) -> bytes:
    return bytes.fromhex(line[_CHECKSUM_DIGITS + 1 : _RECORD_START - 1].decode())
