"""The connection to a database: SQLite made safe, PostgreSQL by URL, faults in one line."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError

from cucumbervision.errors import MissingExtraError, StoreError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["BUSY_TIMEOUT_S", "begin", "database_url", "make_engine", "named", "store_errors"]

BUSY_TIMEOUT_S = 30.0
_WRITES = "cucumbervision_writes"
_HINTS = (
    ("is locked", "another program is writing to it for a long time; try again"),
    ("not a database", "name another file; this one is left as it is"),
    ("malformed", "copy the file away and run 'sqlite3 FILE .recover'"),
    ("unable to open", "check the folder and its permissions"),
    ("readonly", "check the file's permissions"),
    ("attempt to write", "check the file's permissions"),
    ("is full", "make room on the disk"),
    ("No space left", "make room on the disk"),
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
    except ArgumentError:
        raise StoreError("is no address of a database", source="--store", remedy=_USAGE) from None
    backend = url.get_backend_name()
    if backend == "postgresql":
        return url.set(drivername="postgresql+psycopg")
    if backend != "sqlite":
        raise StoreError(f"'{backend}' is not supported", source=named(url), remedy=_USAGE)
    if not url.database or url.database == ":memory:":
        raise StoreError("names no file", source=named(url), remedy=_USAGE)
    return url.set(drivername="sqlite")


_USAGE = "give the path of a file, or postgresql://user@host/database"


def named(url: URL) -> str:
    """Give a database's name for errors: never with its password.

    Examples
    --------
    >>> named(database_url("postgresql://u:secret@h/d"))
    'postgresql+psycopg://u:***@h/d'
    """
    if url.get_backend_name() == "sqlite":
        return url.database or "sqlite"
    return url.render_as_string(hide_password=True)


def make_engine(url: URL) -> Engine:
    """Make the engine.

    SQLite runs in WAL mode, so that who reads never waits for who writes; foreign keys are
    checked; a commit is on the disk before it is acknowledged (`synchronous = FULL`); a writer
    waits for another up to `BUSY_TIMEOUT_S`. A transaction that writes says so when it begins
    (`BEGIN IMMEDIATE`): one that begins by reading and writes later would fail at once, without
    any wait, where another has written in between (SQLite, "Isolation", SQLITE_BUSY_SNAPSHOT).

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
            return create_engine(url, pool_pre_ping=True, connect_args={"client_encoding": "utf8"})
        except ModuleNotFoundError:
            raise MissingExtraError("psycopg", "postgres") from None
    folder = Path(url.database or "").absolute().parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(
            f"cannot be made ({error.strerror})", source=folder, remedy="name another folder"
        ) from None
    engine = create_engine(url, connect_args={"timeout": BUSY_TIMEOUT_S})
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # transactions begin where _begin_sqlite begins them
    cursor = connection.cursor()
    for pragma in ("journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    writes = connection.get_execution_options().get(_WRITES, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


@contextmanager
def begin(engine: Engine, *, write: bool = False) -> Iterator[Connection]:
    """Open one transaction: committed at the end, rolled back by any error.

    One that only reads sees the database as it was when it began, whatever others write.

    Raises
    ------
    StoreError
        If the database says no.
    """
    with store_errors(engine.url), engine.connect() as connection:
        options: dict[str, Any] = {_WRITES: write}
        if not write and connection.dialect.name == "postgresql":
            options["isolation_level"] = "REPEATABLE READ"
        connection = connection.execution_options(**options)
        with connection.begin():
            yield connection


@contextmanager
def store_errors(url: URL) -> Iterator[None]:
    """Turn the database's errors into one line with a remedy.

    Raises
    ------
    StoreError
        For any error of SQLAlchemy or the driver.
    """
    try:
        yield
    except SQLAlchemyError as error:
        cause = error.orig if isinstance(error, DBAPIError) and error.orig else error
        fault = str(cause).strip().splitlines()[0] if str(cause).strip() else type(cause).__name__
        remedy = next((hint for sign, hint in _HINTS if sign in fault), "see the fault's own words")
        raise StoreError(fault, source=named(url), remedy=remedy) from error
