"""The folder of a run's results: every file whole, and a record of each finished capture."""

from __future__ import annotations

import json
import shutil
import tempfile
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import CucumberVisionError, wrap_os_errors
from cucumbervision.files import is_remote, replacing, with_retries
from cucumbervision.run.measurer import Failure

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cucumbervision.run.fields import Cell

RECORDS = "records"
"""Folder of the records, a JSON file a capture."""

_BESIDE_CELLS = frozenset({"pose", "methods"})  # of a fruit of `measurements.json`


@dataclass(frozen=True, kw_only=True)
class CaptureRecord:
    """A finished capture.

    Parameters
    ----------
    key : str
        Hash of all that decides its result, and that of its own files.
    capture : dict
        The capture with its fruit, as in `measurements.json`.
    failures : tuple of Failure
        Rejected instances, and files that could not be written.
    models : list of dict
        The networks that were used.
    picture : str, optional
        Its annotated picture in the output folder; empty if none was asked for, None if it could
        not be written, so that the capture counts as incomplete.
    is_earlier : bool
        Whether an earlier run measured it.
    """

    key: str
    capture: dict[str, Any]
    failures: tuple[Failure, ...]
    models: list[dict[str, Any]]
    picture: str | None
    is_earlier: bool = False

    @property
    def rows(self) -> list[dict[str, Cell]]:
        """The rows of the table of fruit."""
        return [
            {name: cell for name, cell in fruit.items() if name not in _BESIDE_CELLS}
            for fruit in self.capture["fruit"]
        ]

    def as_text(self) -> str:
        """Return the record as one line of JSON."""
        values = {**vars(self), "failures": [vars(failure) for failure in self.failures]}
        return json.dumps(values, ensure_ascii=False, separators=(",", ":"))

    @classmethod
    def of_text(cls, text: str | bytes) -> CaptureRecord:
        """Return the record that `as_text` wrote."""
        values = json.loads(text)
        values["failures"] = tuple(Failure(**failure) for failure in values["failures"])
        return cls(**values)


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
        target: Any = self.path / name
        if is_remote(self.path):
            with tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
                filled = Path(folder) / Path(name).name
                yield filled
                with_retries(target, lambda: target.fs.put_file(str(filled), target.path))
            return
        for place in (target.parent, self._unfinished):
            place.mkdir(parents=True, exist_ok=True)
        with replacing(target, self._unfinished) as filled:
            yield filled

    def find(self, name: str) -> CaptureRecord | None:
        """Return the record of a capture; None if there is none, or it is damaged."""
        path = self.path / RECORDS / f"{name}.json"
        # Neither JSON nor its text, or JSON of something else: the capture is measured again.
        with suppress(FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
            return replace(
                CaptureRecord.of_text(with_retries(path, path.read_bytes)), is_earlier=True
            )
        return None

    def save(self, name: str, record: CaptureRecord) -> None:
        """Write the record of a capture; it is on disk when this method returns.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        self.write(f"{RECORDS}/{name}.json", record.as_text().encode(errors="surrogatepass"))

    @contextmanager
    def locked(self, name: str) -> Iterator[None]:
        """Lock the folder against other programs during the block, if the system can lock files.

        What killed programs left half written is removed.

        Raises
        ------
        CucumberVisionError
            If another program has locked it, or it cannot be written.
        """
        with wrap_os_errors("cannot be written", self.path, "choose another --out"):
            if is_remote(self.path):  # reports immediately if the store is read-only
                self.write(name, b"")
            else:
                (self.path / name).parent.mkdir(parents=True, exist_ok=True)
                file = (self.path / name).open("a")
        try:
            import fcntl
        except ModuleNotFoundError:  # Windows
            fcntl = None  # type: ignore[assignment]
        if is_remote(self.path) or fcntl is None:
            yield
            return
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
