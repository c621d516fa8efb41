"""An output folder with atomic files, and the journal of finished captures.

The journal is a folder `journal/` of segments, each written by one run. A line is a checksum, the
place of the capture and the record as JSON; the last whole line of a place is its record. A partial
line of a killed program is ignored; its capture is measured again.
"""

from __future__ import annotations

import hashlib
import json
import os
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
from cucumbervision.pipeline.fields import FIELDS
from cucumbervision.pipeline.measurer import Failure
from cucumbervision.urls import is_remote, with_retries

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from typing import Self

    from cucumbervision.pipeline.fields import Cell


class OutputFolder:
    """A folder of this machine, or on a store that fsspec knows.

    A file appears whole or not at all. What `write` and `replacing` have put there is on disk (or
    acknowledged by the store) when they return.

    Parameters
    ----------
    path : Path
        Where; as `as_path` returns it.

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

    def has(self, name: str) -> bool:
        """Return whether a file of that name is there."""
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
        """Yield a file of this machine to fill; it takes the name when the block ends well.

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
        target.parent.mkdir(parents=True, exist_ok=True)
        # Its own ending stays last: writers go by it.
        filled = target.with_name(f".{os.getpid()}.{target.name}")
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
    def alone(self, name: str) -> Iterator[None]:
        """Keep other programs out while the block runs, where the system can lock files.

        Raises
        ------
        CucumberVisionError
            If another one is in it.
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
            yield


JOURNAL = "journal"

_HEAD = b'{"format": "cucumbervision-journal", "version": 1}\n'
_CHECK, _PLACE = 8, 32  # hexadecimal digits
_START = _CHECK + 1 + _PLACE + 1

# A store on the network takes whole objects: records wait for each other this long at most.
_BATCH, _BATCH_S = 256, 30.0
_SEGMENTS_HELD = 8


def place_of(address: str, name: str) -> str:
    """Return the key of a capture's place: where it was read from, and its name in the tables.

    Examples
    --------
    >>> len(place_of("house/a/capture.json", "a"))
    32
    """
    return hashlib.blake2b(
        json.dumps([address, name]).encode(), digest_size=_PLACE // 2
    ).hexdigest()


@dataclass(frozen=True)
class JournalRecord:
    """What is known of one measured capture.

    Parameters
    ----------
    place : str
        From `place_of`.
    content : str
        Hash of what it was read from.
    stages : tuple of str
        What its fruit went through, as `Stage` names it.
    digest : str
        Hash of the options and networks of those stages.
    capture : dict
        The capture as `measurements.json` has it, with its fruit.
    failures : tuple of Failure
        What was refused in it, or could not be written.
    models : list of dict
        The networks that took part.
    picture : str, optional
        Its annotated picture in the output folder; None where it could not be written, so that
        the capture is not done.
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
            {fruit_field.name: fruit[fruit_field.name] for fruit_field in FIELDS}
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
        """Return the record of a line that `_is_whole` has let pass."""
        values = json.loads(line[_START:])
        values["failures"] = tuple(Failure(**failure) for failure in values["failures"])
        values["stages"] = tuple(values["stages"])
        return cls(place=line[_CHECK + 1 : _START - 1].decode(), **values)


def _is_whole(line: bytes) -> bool:
    """Return whether a line is a record, written to its end and not changed since."""
    if len(line) <= _START or not line.endswith(b"\n") or line[_CHECK : _CHECK + 1] != b" ":
        return False
    return line[:_CHECK] == b"%08x" % zlib.crc32(line[_CHECK + 1 : -1])


class Journal:
    """The records of an output folder, by place.

    Parameters
    ----------
    out : OutputFolder
        Its segments lie in `journal/`; they are looked through once, and not held in memory.

    Raises
    ------
    CucumberVisionError
        If they cannot be read, or no new one be begun.
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
        last = self._segments[-1].name.split("-")[0] if self._segments else "0"
        # The name tells the run too: on a network's store nothing keeps a second one out.
        self._run = f"{int(last.removesuffix('.jsonl')) + 1:06d}-{uuid.uuid4().hex[:8]}"
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
            if self._out.is_remote:  # tells at once whether it can be written
                self._out.write(f"{JOURNAL}/{self._run}-.jsonl", _HEAD)
                return
            self._folder.mkdir(parents=True, exist_ok=True)
            path = self._folder / f"{self._run}.jsonl"
            # Unbuffered: what a full disk refuses must not come back with the next record.
            self._file = path.open("xb", buffering=0)
            self._file.write(_HEAD)
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
        """Return a segment on a network's store, whole: most often the next record is in it."""
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
        """Add a record: on this machine it is on disk when this returns.

        On a store on the network it waits for others, for half a minute at most: a run that is
        killed measures those again.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        if self._file is None:
            self._waiting.append(record)
            if len(self._waiting) >= _BATCH or time.monotonic() - self._since > _BATCH_S:
                self.flush()
            return
        # What an earlier attempt left half written ends here, and is no record.
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
        """Send what waits.

        Raises
        ------
        OSError
            If it cannot be written; it waits on.
        """
        if not self._waiting:
            return
        lines = [record.line() for record in self._waiting]
        name = f"{self._run}-{self._number:06d}.jsonl"
        self._out.write(f"{JOURNAL}/{name}", _HEAD + b"".join(lines))
        self._segments.append(self._folder / name)
        offset = len(_HEAD)
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
    return bytes.fromhex(line[_CHECK + 1 : _START - 1].decode())
