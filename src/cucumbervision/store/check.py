"""Verify a store: the hashes of its rows, and its pictures.

A stop's hash is of all that was measured there and of where that was: its line, captures, fruit,
masks, methods and artifacts, as the database gives them back. Rounds, corrections, links, the log,
joint measurements and where merging put a stop have a hash a line. Changes by another program and
bit flips on the disk are found by `check_store`, and before an export.
"""

from __future__ import annotations

import hashlib
import json
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import bindparam, or_, select, update

from cucumbervision.errors import StoredImageError, StoreError
from cucumbervision.store.cells import cells_of, columns_of, round_id_of
from cucumbervision.store.records import ImageRef
from cucumbervision.store.schema import (
    IMAGE_COLUMNS,
    ROUND_CELLS,
    Action,
    Artifact,
    CaptureLine,
    DetectionLine,
    Image,
    JointLine,
    LinkLine,
    Mark,
    MaskLine,
    MethodLine,
    RoundLine,
    Row,
    StopArtifact,
    StopLine,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sqlalchemy import Connection

    from cucumbervision.store.engine import Database

_AT_ONCE = 100  # stops whose lines are read together
_NOT_HASHED = {"rows_sha256", "fitted_m", "fitted_sd_m", "sha256"}  # the last is of the others


def sha256_of(*values: Any) -> str:
    """Return the SHA-256 of values that are JSON or bytes, hexadecimal.

    Examples
    --------
    >>> sha256_of("verdict", {"at_s": 1.5}) == sha256_of("verdict", {"at_s": 1.25})
    False
    """
    text = json.dumps(values, sort_keys=True, ensure_ascii=False, default=bytes.hex)
    return hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()


def seal_stops(connection: Connection, which: Any) -> None:
    """Update the hash of all lines of some stops; call it after every change of them.

    Parameters
    ----------
    connection : Connection
        In the transaction that changes them.
    which : SQL expression
        Which lines of `StopLine`.
    """
    ids = connection.execute(select(StopLine.id).where(which)).scalars().all()
    for stop_id, sha256 in _hashes(connection, ids).items():
        line = update(StopLine).where(StopLine.id == stop_id)
        connection.execute(line.values(rows_sha256=sha256))


def _hashes(connection: Connection, stop_ids: Sequence[int]) -> dict[int, str]:
    """Return the hashes of all lines of stops, by the stops' numbers."""
    found = {stop_id: hashlib.sha256() for stop_id in stop_ids}
    for query in _lines_of(stop_ids):
        for stop_id, *cells in cells_of(connection, query):
            found[stop_id].update(sha256_of(*cells).encode())
    return {stop_id: digest.hexdigest() for stop_id, digest in found.items()}


def _lines_of(stop_ids: Sequence[int]) -> Iterator[Any]:
    """Yield queries of all lines of stops, each line with its stop's number first."""
    own = [one for one in StopLine.__table__.columns if one.name not in _NOT_HASHED]
    query = select(StopLine.id, Row.name, *own).outerjoin(Row, Row.id == StopLine.row_id)
    yield query.where(StopLine.id.in_(stop_ids))
    query = select(StopArtifact.stop_id, StopArtifact.number, *Artifact.__table__.columns)
    query = query.join(Artifact, Artifact.id == StopArtifact.artifact_id)
    ordered = query.order_by(StopArtifact.stop_id, StopArtifact.number)
    yield ordered.where(StopArtifact.stop_id.in_(stop_ids))
    there, of = CaptureLine.stop_id.in_(stop_ids), CaptureLine.stop_id
    yield select(of, *CaptureLine.__table__.columns).where(there).order_by(CaptureLine.id)
    names = (CaptureLine.color_sha256, CaptureLine.depth_sha256, CaptureLine.thumbnail_sha256)
    query = select(of, *IMAGE_COLUMNS).join(Image, or_(*(Image.sha256 == name for name in names)))
    yield query.where(there).order_by(CaptureLine.id, Image.sha256)
    in_capture = CaptureLine.id == DetectionLine.capture_id
    query = select(of, *DetectionLine.__table__.columns).join(CaptureLine, in_capture)
    yield query.where(there).order_by(DetectionLine.id)
    for table in (MaskLine, MethodLine):
        query = select(of, *table.__table__.columns)
        query = query.join(DetectionLine, DetectionLine.id == table.fruit_id)
        query = query.join(CaptureLine, in_capture).where(there)
        yield query.order_by(*table.__table__.primary_key)


# Of tables whose lines have a hash each: their name, and the columns that it is of.
_HASHED: dict[Any, tuple[str, tuple[str, ...]]] = {
    RoundLine: ("round", (*ROUND_CELLS, "deleted")),
    StopLine: ("position of stop", ("key", "fitted_m", "fitted_sd_m")),
    Mark: ("correction", ("fruit_id", "slot", "value", "details", "action_id", "ended_by_id")),
    LinkLine: (
        "link",
        (
            *("kind", "first_id", "second_id", "first_round_id", "second_round_id", "score"),
            *("action_id", "ended_by_id"),
        ),
    ),
    Action: (
        "line of the log",
        ("at_s", "by", "kind", "round_id", "fruit", "details", "undoes_id"),
    ),
    JointLine: (
        "joint measurement",
        ("key", "round_id", "first", "views", "reason", "record", "drawing"),
    ),
}


def with_hash(table: Any, cells: dict[str, Any]) -> dict[str, Any]:
    """Return the cells of a new line of a table whose lines have a hash each, with that hash."""
    columns = columns_of(table, _HASHED[table][1])
    said = [_as_stored(column, cells.get(column.name)) for column in columns]
    return {**cells, "sha256": sha256_of(*said)}


def _as_stored(column: Any, value: Any) -> Any:
    """Return a cell's value as the database gives it back: 1 is 1.0 among floats."""
    return float(value) if value is not None and column.type.python_type is float else value


def change(connection: Connection, table: Any, which: Any, **values: Any) -> int:
    """Change lines of a table whose lines have a hash each; return how many.

    Parameters
    ----------
    connection : Connection
        In a transaction.
    table : type
        The table.
    which : SQL expression
        Which of its lines; no other transaction changes them until this one ends.
    **values
        What they get.
    """
    names = _HASHED[table][1]
    query = select(table.id, *columns_of(table, names)).where(which)
    lines = cells_of(connection, query.with_for_update(key_share=True))
    changed = [
        {
            "line": line,
            "hash": with_hash(table, {**dict(zip(names, cells, strict=True)), **values})["sha256"],
        }
        for line, *cells in lines
    ]
    if changed:
        one = update(table).where(table.id == bindparam("line"))
        connection.execute(one.values(**values, sha256=bindparam("hash")), changed)
    return len(changed)


def refuse_changed(store: Database, round_key: str) -> None:
    """Raise if any part of a round differs from what was saved.

    Raises
    ------
    StoreError
        If it does; the message names the first difference.
    """
    if changed := changed_lines(store, round_key):
        remedy = "copy the store back from a backup; `round check` names all that was changed"
        raise StoreError(changed[0], source=store.name, remedy=remedy)


def changed_lines(store: Database, round_key: str | None = None) -> list[str]:
    """Return descriptions of everything that differs from what was saved.

    Parameters
    ----------
    store : Store
        The store.
    round_key : str, optional
        Of that round alone.

    Raises
    ------
    StoreError
        If the stored data cannot be read.
    """
    found = []
    with store.reading() as connection:
        number = None if round_key is None else round_id_of(connection, round_key)
        stops = select(StopLine.id, StopLine.key, StopLine.rows_sha256).order_by(StopLine.id)
        if number is not None:
            stops = stops.where(StopLine.round_id == number)
        rows = cells_of(connection, stops)
        for first in range(0, len(rows), _AT_ONCE):
            some = rows[first : first + _AT_ONCE]
            now = _hashes(connection, [row[0] for row in some])
            found += [f"stop {key} is not as it was saved" for i, key, was in some if now[i] != was]
        for table, (what, names) in _HASHED.items():
            lines = select(table.id, table.sha256, *columns_of(table, names)).order_by(table.id)
            if number is not None and table is Mark:
                lines = lines.join(DetectionLine, DetectionLine.id == Mark.fruit_id)
            if number is not None:
                lines = lines.where(_in_round(table, number))
            for line, was, *cells in cells_of(connection, lines):
                if sha256_of(*cells) != was:
                    found.append(f"{what} {line} is not as it was saved")
    return found


def _in_round(table: Any, number: int) -> Any:
    """Return which lines of a table belong to a round, for a query."""
    if table is RoundLine:
        return RoundLine.id == number
    if table is LinkLine:
        return or_(LinkLine.first_round_id == number, LinkLine.second_round_id == number)
    return (DetectionLine if table is Mark else table).round_id == number


_GRACE_S = 3600.0  # longer than any program takes between a picture and the stop that names it

_ASIDE = ".removing"


@dataclass(frozen=True)
class CheckReport:
    """What was found.

    Parameters
    ----------
    pictures : int
        How many the database names.
    missing, damaged : tuple of Path
        Pictures that are missing, or whose content differs from their name.
    orphans : tuple of Path
        Files that no stop names: a program ended between its pictures and its stop.
    removed : tuple of Path
        Which orphans were removed.
    faults : tuple of str
        Faults that SQLite reports in its file, and the result of `changed_lines`.
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


def check_store(store: Database, *, remove: bool = False, grace_s: float = _GRACE_S) -> CheckReport:
    """Check a store against its hashes and pictures; files that a stop names are never removed.

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
    if remove:
        _bring_back(store)
    with store.reading() as connection:
        rows = cells_of(connection, select(*IMAGE_COLUMNS))
    refs = {row[0]: ImageRef(*row) for row in rows}
    missing, damaged = [], []
    for ref in refs.values():
        path = store.images.path(ref)
        if not path.exists():
            missing.append(path)
        elif not _whole(store, ref):
            damaged.append(path)
    orphans = _orphans(store, refs, time.time() - grace_s)
    return CheckReport(
        len(refs),
        tuple(missing),
        tuple(damaged),
        tuple(orphans),
        tuple(path for path in orphans if _removed(store, path, grace_s)) if remove else (),
        (*_faults(store), *changed_lines(store)),
    )


def _whole(store: Database, ref: ImageRef) -> bool:
    try:
        store.images.read(ref)
    except StoredImageError:
        return False
    return True


def _orphans(store: Database, refs: dict[str, ImageRef], before_s: float) -> list[Path]:
    named = {store.images.path(ref) for ref in refs.values()}
    files = store.images.files()
    return sorted(path for path in files if path not in named and _older(path, before_s))


def _older(path: Path, before_s: float) -> bool:
    try:
        return path.stat().st_mtime < before_s
    except FileNotFoundError:  # another program removed or finished it
        return False


def _removed(store: Database, path: Path, grace_s: float) -> bool:
    """Remove one orphan, unless another program is about to use it.

    The file is renamed first; then its time and the database are checked again. A writer of the
    same picture either finds it before that and updates its time, so that it is restored, or
    does not find it, and writes it again.
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


def _bring_back(store: Database) -> None:
    """Restore files that an interrupted check was removing."""
    for aside in list(store.images.files()):
        if aside.name.endswith(_ASIDE):
            path = aside.with_name(aside.name.removesuffix(_ASIDE))
            with suppress(FileNotFoundError):
                aside.unlink() if path.exists() else aside.replace(path)


def _is_named(store: Database, sha256: str) -> bool:
    with store.reading() as connection:
        query = select(Image.sha256).where(Image.sha256 == sha256)
        return connection.execute(query).first() is not None


def _faults(store: Database) -> tuple[str, ...]:
    if store.engine.dialect.name != "sqlite":
        return ()
    with store.reading() as connection:
        said = connection.exec_driver_sql("PRAGMA integrity_check").scalars().all()
        loose = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
    faults = [str(line) for line in said if line != "ok"]
    return (*faults, *(f"{row[0]} names a line of {row[2]} that is not there" for row in loose))
