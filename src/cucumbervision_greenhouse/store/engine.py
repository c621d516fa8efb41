"""The database connection: safe settings for SQLite, PostgreSQL by URL, errors in one line.

A new database gets its tables when it is opened; one of another version is refused untouched.
"""

from __future__ import annotations

import json
import os
import re
import sqlite3
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from copy import copy
from pathlib import Path
from typing import Any, Self

from sqlalchemy import (
    Column,
    Connection,
    Engine,
    create_engine,
    event,
    exc,
    func,
    inspect,
    select,
    text,
)
from sqlalchemy.engine import URL, make_url

from cucumbervision import errors
from cucumbervision_greenhouse.store.images import ImageStore
from cucumbervision_greenhouse.store.schema import FRUIT, METADATA, VERSION

BUSY_TIMEOUT_S = 30.0
SIGNED_BY = "cucumbervision_signed_by"
"""Name of the connection option with the person who writes."""
DEVICE = "cucumbervision_device"
"""Name of the connection option with the device that the person writes from."""

_WRITES = "cucumbervision_writes"
_POSTGRES_LOCK = 0x63766D31  # arbitrary; the advisory lock of who writes
_NULL = re.compile(r"(?<!\\)((?:\\\\)*)\\u0000")
_MAKE_ROOM = "make room on the disk"
_COMES_BACK = "the server starts again after a fault; try again in a minute"
_HINTS = (
    ("is locked", "another program is writing to it for a long time; try again"),
    ("not a database", "name another file; this one is left as it is"),
    ("malformed", "copy the file away and run 'sqlite3 FILE .recover'"),
    ("unable to open", "check the folder and its permissions"),
    ("readonly", "check the file's permissions"),
    ("attempt to write", "check the file's permissions"),
    ("is full", _MAKE_ROOM),
    ("No space left", _MAKE_ROOM),
    ("could not extend file", _MAKE_ROOM),  # PostgreSQL, where half a page still fitted
    ("in recovery mode", _COMES_BACK),
    ("not yet accepting connections", _COMES_BACK),
    ("is starting up", _COMES_BACK),
    ("connection", "check that the PostgreSQL server runs, and the address and password"),
)


def database_url(where: str | Path) -> URL:
    """Read a database's address: a URL, or the path of an SQLite file.

    Parameters
    ----------
    where : str or Path
        'house.db', 'sqlite:///house.db' or 'postgresql://user@host/name'.

    Raises
    ------
    StoreError
        If it is neither, or no file.

    Examples
    --------
    >>> database_url("house.db").drivername, database_url("postgresql://u@h/d").drivername
    ('sqlite', 'postgresql+psycopg')
    """
    text = str(where)
    try:
        url = make_url(text) if "://" in text else URL.create("sqlite", database=text)
    except exc.ArgumentError:
        raise errors.StoreError(
            "is not a database address", source="--store", remedy=_USAGE
        ) from None
    backend = url.get_backend_name()
    if backend == "postgresql":
        return url.set(drivername="postgresql+psycopg")
    if backend != "sqlite":
        raise errors.StoreError(f"'{backend}' is not supported", source=named(url), remedy=_USAGE)
    if not url.database or url.database == ":memory:":
        raise errors.StoreError("names no file", source=named(url), remedy=_USAGE)
    return url.set(drivername="sqlite")


_USAGE = "give the path of a file, or postgresql://user@host/database"


def named(url: URL) -> str:
    """Return a database's name for errors, without its password.

    Examples
    --------
    >>> named(database_url("postgresql://u:secret@h/d"))
    'postgresql+psycopg://u:***@h/d'
    """
    if url.get_backend_name() == "sqlite":
        return url.database or "sqlite"
    return url.render_as_string(hide_password=True)


def stored_json(value: Any) -> str:
    r"""Return a value as JSON, with a question mark for what no database takes.

    That is a null, and half of a surrogate pair, as which Python reads the bytes of a file's name
    that are no text.

    Raises
    ------
    StoreError
        If it holds a number that is not finite, or a value that JSON has not.

    Examples
    --------
    >>> stored_json({"path_m": ((0.1, 0.2),), "source": "a\0\ud800"})
    '{"path_m": [[0.1, 0.2]], "source": "a??"}'
    """
    try:
        content = json.dumps(value, default=vars, allow_nan=False, ensure_ascii=False)
    except (ValueError, TypeError) as error:
        raise errors.StoreError(
            f"the record cannot be stored ({error})", remedy="give finite numbers and plain values"
        ) from None
    return _NULL.sub(r"\1?", content.encode(errors="replace").decode())


def make_engine(url: URL) -> Engine:
    """Make the engine.

    SQLite runs in WAL mode, so that readers never wait for writers; foreign keys are checked; a
    commit is on the disk before it is acknowledged (`synchronous = FULL`); a writer waits for
    another up to `BUSY_TIMEOUT_S`. A writing transaction begins with `BEGIN IMMEDIATE`: one that
    begins by reading and writes later would fail at once where another has written in between
    (SQLite, "Isolation", SQLITE_BUSY_SNAPSHOT).

    A file that may not be written, or whose folder may not, is opened for reading alone.

    Raises
    ------
    MissingExtraError
        If PostgreSQL's driver is not installed.
    StoreError
        If the file's folder cannot be made.
    """
    if url.get_backend_name() != "sqlite":
        try:
            # A server whose databases have no encoding would give bytes for texts.
            encoding = {"client_encoding": "utf8"}
            return create_engine(
                url, pool_pre_ping=True, connect_args=encoding, json_serializer=stored_json
            )
        except ModuleNotFoundError:
            raise errors.MissingExtraError("psycopg", "postgres") from None
    path = Path(url.database or "").absolute()
    if path.exists() and not all(
        os.access(checked_path, os.W_OK, effective_ids=True) for checked_path in (path, path.parent)
    ):
        engine = create_engine(url, creator=lambda: _open_read_only(path))
        event.listen(engine, "begin", _begin_sqlite)
        return engine
    with errors.wrap_os_errors(
        "cannot be made", path.parent, "name another folder", errors.StoreError
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
    timeout = {"timeout": BUSY_TIMEOUT_S}
    engine = create_engine(url, connect_args=timeout, json_serializer=stored_json)
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _open_read_only(path: Path) -> sqlite3.Connection:
    """Open an SQLite file without write permission.

    If no other program has it open, there is no WAL file, and SQLite cannot create one: it can
    then be read only as an immutable file.
    """
    log = path.with_name(f"{path.name}-wal")
    alone = not log.exists() or not log.stat().st_size
    address = f"{path.as_uri()}?mode=ro{'&immutable=1' if alone else ''}"
    return sqlite3.connect(
        address, uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False
    )


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # transactions begin where _begin_sqlite begins them
    # A file stays in WAL mode. While another writes to one that is not, SQLite refuses to switch.
    with suppress(sqlite3.OperationalError):
        connection.execute("PRAGMA journal_mode = WAL")
    for pragma in ("synchronous = FULL", "foreign_keys = ON"):
        connection.execute(f"PRAGMA {pragma}")


def _begin_sqlite(connection: Connection) -> None:
    writes = connection.get_execution_options().get(_WRITES, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


@contextmanager
def begin(engine: Engine, *, write: bool = False) -> Iterator[Connection]:
    """Open one transaction: committed at the end, rolled back by any error.

    A read-only transaction sees the database as it was at its start; one transaction writes at a
    time.

    Raises
    ------
    StoreError
        If the database reports an error.
    """
    with _store_errors(engine.url), engine.connect() as connection:
        options: dict[str, Any] = {_WRITES: write}
        if not write and connection.dialect.name == "postgresql":
            options["isolation_level"] = "REPEATABLE READ"
        connection = connection.execution_options(**options)
        with connection.begin():
            if write and connection.dialect.name == "postgresql":
                connection.execute(select(func.pg_advisory_xact_lock(_POSTGRES_LOCK)))
            yield connection


@contextmanager
def _store_errors(url: URL) -> Iterator[None]:
    """Convert database errors to one line with a remedy.

    Raises
    ------
    StoreError
        For any error of SQLAlchemy or the driver.
    """
    try:
        yield
    except UnicodeError as error:  # SQLite names what is damaged with its damaged bytes
        raise errors.StoreError(
            "the file is damaged",
            source=named(url),
            remedy="copy the file away and run 'sqlite3 FILE .recover'",
        ) from error
    except OverflowError as error:
        raise errors.StoreError(
            "a number is too large for the database", source=named(url), remedy="give a smaller one"
        ) from error
    except exc.SQLAlchemyError as error:
        if isinstance(error, exc.StatementError) and isinstance(error.orig, errors.StoreError):
            raise error.orig from None
        cause = error.orig if isinstance(error, exc.DBAPIError) and error.orig else error
        fault = str(cause).strip().splitlines()[0] if str(cause).strip() else type(cause).__name__
        remedy = next((hint for sign, hint in _HINTS if sign in fault), "see the fault's own words")
        away = (
            errors.StoreAwayError if isinstance(error, exc.OperationalError) else errors.StoreError
        )
        kind = errors.DiskFullError if remedy == _MAKE_ROOM else away
        raise kind(fault, source=named(url), remedy=remedy) from error


class Database:
    """An open database and the folder of its images. Any number of threads may use one.

    Parameters
    ----------
    engine : sqlalchemy.Engine
        The connection, as `make_engine` makes it.
    images : Path, optional
        Folder of the images, where it is known.
    """

    def __init__(self, engine: Engine, images: Path | None) -> None:
        self.engine = engine
        self._images = images
        self._signed_by = self._device = ""

    def signed(self, by: str, device: str = "") -> Self:
        """Return the same database, with this person's name in the log of manual actions.

        `device` tells people apart who have no names: a browser's own random name.
        """
        signed_store = copy(self)
        signed_store._signed_by, signed_store._device = by, device
        return signed_store

    @property
    def name(self) -> str:
        """The database's name, without its password."""
        return named(self.engine.url)

    @property
    def images(self) -> ImageStore:
        """The images beside the database."""
        if self._images is None:
            raise errors.StoreError(
                "the folder of the pictures is not known",
                source=self.name,
                remedy="open the store with images=FOLDER, or postgresql://…?images=FOLDER",
            )
        return ImageStore(self._images)

    def reading(self) -> AbstractContextManager[Connection]:
        """Open a transaction that only reads."""
        return begin(self.engine)

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """Open a transaction that writes."""
        with begin(self.engine, write=True) as connection:
            yield connection.execution_options(**{SIGNED_BY: self._signed_by, DEVICE: self._device})

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


VERSION_TABLE = "cucumbervision_version"


def prepare(engine: Engine) -> None:
    """Make the tables of a new store, or bring those of an earlier version here.

    All in one transaction: two programs that open a store at once wait for each other, and one that
    is killed meanwhile leaves the database as it was.

    Raises
    ------
    StoreVersionError
        If a later version of the software wrote it; nothing is changed.
    StoreError
        If the database holds another program's tables under our names.
    """
    with begin(engine) as connection:
        if stored_version(connection) == VERSION and not _missing_columns(connection):
            return
    with begin(engine, write=True) as connection:
        version = stored_version(connection)
        if version is None:
            _check_free(connection, named(engine.url))
            METADATA.create_all(connection, checkfirst=False)
            connection.execute(text(f"CREATE TABLE {VERSION_TABLE} (version TEXT NOT NULL)"))
            connection.execute(text(f"INSERT INTO {VERSION_TABLE} VALUES (:v)"), {"v": VERSION})
        elif version != VERSION:
            _migrate(connection, version, named(engine.url))
        for column in _missing_columns(connection):
            kind = column.type.compile(connection.dialect)
            connection.execute(text(f"ALTER TABLE fruit ADD COLUMN {column.name} {kind}"))


def _migrate(connection: Connection, version: str, source: str) -> None:
    """Bring the tables of an earlier version to this one."""
    from alembic.migration import MigrationContext
    from alembic.operations import Operations

    from cucumbervision_greenhouse.store.migrations import STEPS

    if version not in STEPS:
        raise errors.StoreVersionError(
            f"has schema {version}, and this software reads schema {min(STEPS)} to {VERSION}",
            source=source,
            remedy="use the version of cucumbervision that wrote it; nothing was changed",
        )
    with Operations.context(MigrationContext.configure(connection)):
        STEPS[version]()
    connection.execute(text(f"UPDATE {VERSION_TABLE} SET version = :v"), {"v": VERSION})


def _missing_columns(connection: Connection) -> list[Column[Any]]:
    """Return the columns of `fields.csv` that the table does not have yet, such as a new trait's.

    They may be empty, so that older software can still use such a database.
    """
    stored_names = {column["name"] for column in inspect(connection).get_columns("fruit")}
    return [column for column in FRUIT.columns if column.name not in stored_names]


def stored_version(connection: Connection) -> str | None:
    """Return the version of a database's tables; None where there is no store yet."""
    if not inspect(connection).has_table(VERSION_TABLE):
        return None
    version = connection.execute(text(f"SELECT version FROM {VERSION_TABLE}")).scalar()
    return None if version is None else str(version)


def _check_free(connection: Connection, source: str) -> None:
    taken = set(inspect(connection).get_table_names()) & set(METADATA.tables)
    if taken:
        raise errors.StoreError(
            f"holds tables of another program ({', '.join(sorted(taken))})",
            source=source,
            remedy="name another database; nothing was changed",
        )
