"""Bring a database to the software's own version when it is opened, or refuse it untouched."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import inspect, text

from cucumbervision.errors import StoreError, StoreVersionError
from cucumbervision.store.engine import begin, named
from cucumbervision.store.schema import Base

if TYPE_CHECKING:
    from sqlalchemy import Connection, Engine

__all__ = ["HEAD", "MIGRATIONS", "REVISIONS", "VERSION_TABLE", "migrate", "stored_revision"]

REVISIONS = ("0001",)
HEAD = REVISIONS[-1]
VERSION_TABLE = "cucumbervision_version"
MIGRATIONS = Path(__file__).with_name("migrations")

_POSTGRES_LOCK = 0x63766D31  # any number that nobody else takes for an advisory lock


def migrate(engine: Engine) -> None:
    """Make the tables, or bring them up to date, in one transaction.

    Two programs that open a new store at once wait for each other; one that is killed meanwhile
    leaves the database as it was.

    Raises
    ------
    StoreVersionError
        If a newer version of the software wrote it; nothing is changed.
    StoreError
        If the database holds tables of ours that no version made.
    """
    with begin(engine) as connection:
        if stored_revision(connection) == HEAD:
            return
    with begin(engine, write=True) as connection:
        if connection.dialect.name == "postgresql":
            connection.execute(text("SELECT pg_advisory_xact_lock(:n)"), {"n": _POSTGRES_LOCK})
        found = stored_revision(connection)
        if found == HEAD:
            return
        if found is not None and found not in REVISIONS:
            raise StoreVersionError(
                f"its version {found} is newer than this software's {HEAD}",
                source=named(engine.url),
                remedy="update cucumbervision; nothing was changed",
            )
        if found is None:
            _check_free(connection, named(engine.url))
        _upgrade(connection)


def stored_revision(connection: Connection) -> str | None:
    """Give the revision that the database was left at; None where there is no store yet."""
    if not inspect(connection).has_table(VERSION_TABLE):
        return None
    found = connection.execute(text(f"SELECT version_num FROM {VERSION_TABLE}")).scalar()
    return None if found is None else str(found)


def _check_free(connection: Connection, source: str) -> None:
    taken = set(inspect(connection).get_table_names()) & set(Base.metadata.tables)
    if taken:
        raise StoreError(
            f"holds tables of another program ({', '.join(sorted(taken))})",
            source=source,
            remedy="name another database; nothing was changed",
        )


def _upgrade(connection: Connection) -> None:
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")
