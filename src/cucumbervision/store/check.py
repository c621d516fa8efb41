"""Look a store over: is every picture there and whole, and is there none too many."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sqlalchemy import select

from cucumbervision.errors import StoredImageError
from cucumbervision.store.engine import begin
from cucumbervision.store.reading import IMAGE_COLUMNS
from cucumbervision.store.records import ImageRef
from cucumbervision.store.schema import Image

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision.store.repository import Store

__all__ = ["CheckReport", "check_store"]

GRACE_S = 3600.0  # longer than any program takes between a picture and the stop that names it
_ASIDE = ".removing"


@dataclass(frozen=True)
class CheckReport:
    """What was found.

    Parameters
    ----------
    pictures : int
        How many the database names.
    missing, damaged : tuple of Path
        Which of them are not there, or are not what their names say.
    orphans : tuple of Path
        Files that no stop names: a program ended between its pictures and its stop.
    removed : tuple of Path
        Which orphans were removed.
    faults : tuple of str
        What SQLite says of its own file; empty where it is sound.
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


def check_store(
    store: Store, *, contents: bool = True, remove: bool = False, grace_s: float = GRACE_S
) -> CheckReport:
    """Look a store over; nothing that a stop names is ever removed.

    Parameters
    ----------
    store : Store
        The store; others may be writing to it.
    contents : bool
        Hold every picture against its hash, which reads them all; or only see that it is there.
    remove : bool
        Remove orphans, and files whose writing was broken off.
    grace_s : float
        Younger files are left alone: the stop that names them may be on its way.

    Raises
    ------
    StoreError
        If the database cannot be read.
    """
    if remove:
        _bring_back(store)
    refs = _named(store)
    missing, damaged = [], []
    for ref in refs.values():
        path = store.images.path(ref)
        if not path.exists():
            missing.append(path)
        elif contents and not _whole(store, ref):
            damaged.append(path)
    orphans = _orphans(store, refs, time.time() - grace_s)
    return CheckReport(
        len(refs),
        tuple(missing),
        tuple(damaged),
        tuple(orphans),
        tuple(path for path in orphans if _removed(store, path, grace_s)) if remove else (),
        _faults(store),
    )


def _named(store: Store) -> dict[str, ImageRef]:
    with begin(store.engine) as connection:
        refs = [ImageRef(*row) for row in connection.execute(select(*IMAGE_COLUMNS)).all()]
    return {ref.sha256: ref for ref in refs}


def _whole(store: Store, ref: ImageRef) -> bool:
    try:
        store.images.read(ref)
    except StoredImageError:
        return False
    return True


def _orphans(store: Store, refs: dict[str, ImageRef], before_s: float) -> list[Path]:
    named = {store.images.path(ref) for ref in refs.values()}
    files = [*store.images.files(), *store.images.unfinished()]
    return sorted(path for path in files if path not in named and _older(path, before_s))


def _older(path: Path, before_s: float) -> bool:
    try:
        return path.stat().st_mtime < before_s
    except FileNotFoundError:  # another program removed or finished it
        return False


def _removed(store: Store, path: Path, grace_s: float) -> bool:
    """Remove one orphan, unless somebody is about to use it.

    It is first taken away under another name, and its time and the database are then asked
    again. Whoever puts the same picture either finds it before that, which makes its time new,
    so that it is brought back; or does not find it, and writes it anew.
    """
    aside = path.with_name(path.name + _ASIDE)
    try:
        path.replace(aside)
    except FileNotFoundError:
        return False
    if _older(aside, time.time() - grace_s) and not _is_named(store, path.stem):
        aside.unlink(missing_ok=True)
        return True
    if path.exists():
        aside.unlink(missing_ok=True)
    else:
        aside.replace(path)
    return False


def _bring_back(store: Store) -> None:
    """Give files their names again that a check was just removing when it was killed."""
    for aside in list(store.images.files()):
        if aside.name.endswith(_ASIDE):
            path = aside.with_name(aside.name.removesuffix(_ASIDE))
            with suppress(FileNotFoundError):
                aside.unlink() if path.exists() else aside.replace(path)


def _is_named(store: Store, sha256: str) -> bool:
    with begin(store.engine) as connection:
        query = select(Image.sha256).where(Image.sha256 == sha256)
        return connection.execute(query).first() is not None


def _faults(store: Store) -> tuple[str, ...]:
    if store.engine.dialect.name != "sqlite":
        return ()
    with begin(store.engine) as connection:
        said = connection.exec_driver_sql("PRAGMA integrity_check").scalars().all()
        loose = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
    faults = [str(line) for line in said if line != "ok"]
    return (*faults, *(f"{row[0]} names a line of {row[2]} that is not there" for row in loose))
