"""Verify a store: the database's own check, and the hashes of its images."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import select

from cucumbervision.errors import StoredImageError
from cucumbervision_greenhouse.store.engine import Database
from cucumbervision_greenhouse.store.schema import CAPTURES

_GRACE_S = 3600.0  # longer than any program takes between an image and the stop that names it
_IMAGES = (CAPTURES.c.color, CAPTURES.c.depth, CAPTURES.c.thumbnail)


@dataclass(frozen=True)
class StoreCheck:
    """What was found.

    Parameters
    ----------
    pictures : int
        How many the database names.
    missing, damaged : tuple of Path
        Images that are missing, or whose content differs from their name.
    orphans : tuple of Path
        Files that no stop names: a program ended between its images and its stop.
    removed : tuple of Path
        Which orphans were removed.
    faults : tuple of str
        Faults that SQLite reports in its file.
    """

    pictures: int
    missing: tuple[Path, ...]
    damaged: tuple[Path, ...]
    orphans: tuple[Path, ...]
    removed: tuple[Path, ...]
    faults: tuple[str, ...]

    @property
    def sound(self) -> bool:
        """Whether nothing that was saved is missing or damaged."""
        return not (self.missing or self.damaged or self.faults)


def check_store(store: Database, *, remove: bool = False, grace_s: float = _GRACE_S) -> StoreCheck:
    """Check a store and its images; files that a stop names are never removed.

    Parameters
    ----------
    store : Store
        The store; others may be writing to it.
    remove : bool
        Remove orphans.
    grace_s : float
        Newer files are kept: the stop that names them may not be saved yet.

    Raises
    ------
    StoreError
        If the database cannot be read.
    """
    with store.reading() as connection:
        lines = connection.execute(select(*_IMAGES))
        names = sorted({name for line in lines for name in line if name is not None})
    named = {name: store.images.path(name) for name in names}
    missing = [path for path in named.values() if not path.exists()]
    present = [name for name, path in named.items() if path not in set(missing)]
    damaged = [named[name] for name in present if not _is_whole(store, name)]
    orphans = []
    for path in sorted(set(store.images.files()) - set(named.values())):
        # Another program may remove or finish it; one that puts such an image again first makes
        # its time of change now.
        with suppress(FileNotFoundError):
            if path.stat().st_mtime < time.time() - grace_s:
                orphans.append(path)
                if remove:
                    path.unlink(missing_ok=True)
    return StoreCheck(
        pictures=len(names),
        missing=tuple(missing),
        damaged=tuple(damaged),
        orphans=tuple(orphans),
        removed=tuple(orphans) if remove else (),
        faults=_faults(store),
    )


def _is_whole(store: Database, name: str) -> bool:
    try:
        store.images.read(name)
    except StoredImageError:
        return False
    return True


def _faults(store: Database) -> tuple[str, ...]:
    if store.engine.dialect.name != "sqlite":
        return ()
    with store.reading() as connection:
        report_lines = connection.exec_driver_sql("PRAGMA integrity_check").scalars().all()
        loose = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
    faults = [str(line) for line in report_lines if line != "ok"]
    return (*faults, *(f"{row[0]} names a line of {row[2]} that is not there" for row in loose))
