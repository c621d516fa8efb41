"""A folder that results are written into so that they outlive whatever ends the program."""

from __future__ import annotations

import os
import tempfile
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.files import sync_folder
from cucumbervision.capture.urls import is_remote, with_retries
from cucumbervision.errors import CucumberVisionError, wrap_os_errors

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_ASIDE = "earlier"
"""Where `put_aside` moves what a fresh run begins without."""


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

    def put_aside(self, names: Sequence[str]) -> Path | None:
        """Move files and folders below `earlier/`, in a folder named by the time.

        Returns
        -------
        Path or None
            That folder; None where nothing was there.

        Raises
        ------
        CucumberVisionError
            If they cannot be moved.
        """
        there = [name for name in names if self.has(name)]
        if not there:
            return None
        stamp = datetime.now(UTC).strftime("%Y-%m-%dT%H-%M-%S")
        aside, number = self.path / _ASIDE / stamp, 1
        while aside.exists():
            number += 1
            aside = self.path / _ASIDE / f"{stamp}-{number}"
        with wrap_os_errors("cannot be put aside", self.path):
            if not self.is_remote:
                aside.mkdir(parents=True, exist_ok=True)
            for name in there:
                self._move(self.path / name, aside / name)
        return aside

    def _move(self, source: Any, target: Any) -> None:
        if not self.is_remote:
            source.rename(target)
            return
        files = source.fs.find(source.path)
        for file in files:
            source.fs.cp_file(file, f"{target.path}{file.removeprefix(source.path)}")
        source.fs.rm(files)

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
