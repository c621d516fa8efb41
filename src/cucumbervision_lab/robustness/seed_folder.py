"""A folder of valid files that is damaged, read and put back a million times."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True)
class SeedFolder:
    """A folder, and the files that belong into it.

    Parameters
    ----------
    root : str
        The folder.
    files : mapping of str to bytes
        By their path below it.
    """

    root: str
    files: Mapping[str, bytes]

    @classmethod
    def of(cls, folder: Path) -> Self:
        """Take a folder as it is now."""
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        return cls(str(folder), {str(p.relative_to(folder)): p.read_bytes() for p in files})

    def restore(self, damaged: str = "", *, everything: bool = False) -> None:
        """Put the folder back as it was.

        Parameters
        ----------
        damaged : str
            The file that is surely not as it was; databases are written by their readers, too.
        everything : bool
            Write all files again.
        """
        there: set[str] = set()
        self._remove_strange("", there)
        for name, data in self.files.items():
            if everything or name == damaged or name not in there or name.endswith(".db"):
                path = Path(self.root, name)
                if name not in there:
                    path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)

    def _remove_strange(self, below: str, there: set[str]) -> None:
        """Remove what does not belong here, and note the files that do."""
        try:
            entries = list(os.scandir(f"{self.root}/{below}"))
        except FileNotFoundError:
            return
        for entry in entries:
            name = below + entry.name
            if name in self.files and entry.is_file(follow_symlinks=False):
                there.add(name)
            elif not entry.is_dir(follow_symlinks=False):
                Path(entry.path).unlink()
            elif any(known.startswith(f"{name}/") for known in self.files):
                self._remove_strange(f"{name}/", there)
            else:
                shutil.rmtree(entry.path)
