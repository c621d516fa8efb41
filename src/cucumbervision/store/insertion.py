"""Insert lines: those of which others may just be inserting the same, and those of the log."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, cast

from sqlalchemy import insert, select
from sqlalchemy.dialects import postgresql, sqlite

from cucumbervision.store.engine import SIGNED_BY
from cucumbervision.store.schema import Action, Round, Row

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sqlalchemy import Connection

    from cucumbervision.store.schema import Base

__all__ = ["id_of", "insert_new", "log_action", "row_id_of"]


def log_action(
    connection: Connection,
    kind: str,
    by: str,
    round_id: int | None,
    fruit: Sequence[str] = (),
    details: dict[str, Any] | None = None,
    **cells: Any,
) -> int:
    """Add a line to the log and return its number.

    `by` names who did it; without it, who the store is signed by (`Database.signed`).
    """
    line = insert(Action).values(
        at_s=time.time(),
        by=by or connection.get_execution_options().get(SIGNED_BY, ""),
        kind=kind,
        round_id=round_id,
        fruit=list(fruit),
        details=details or {},
        **cells,
    )
    return connection.execute(line.returning(Action.id)).scalar_one()


def insert_new(
    connection: Connection, table: type[Base], cells: dict[str, Any], *unique: str
) -> int | None:
    """Insert one line and return its id; None where one with that key is there already.

    Where another transaction is just inserting the same key, PostgreSQL waits for its end.
    """
    dialect = sqlite if connection.dialect.name == "sqlite" else postgresql
    line = dialect.insert(table).values(**cells).on_conflict_do_nothing(index_elements=unique)
    key: Any = next(iter(table.__table__.primary_key))
    return cast("int | None", connection.execute(line.returning(key)).scalar())


def id_of(connection: Connection, table: Any, cells: dict[str, Any], *unique: str) -> int:
    """Return the id of the line with these cells, inserted where it is not there yet."""
    query = select(table.id).where(*(getattr(table, name) == cells[name] for name in unique))
    found = connection.execute(query).scalar()
    if found is None:
        found = insert_new(connection, table, cells, *unique)
    return cast("int", connection.execute(query).scalar_one() if found is None else found)


def row_id_of(connection: Connection, round_id: int, name: str) -> int:
    """Return the id of a row of a round's house, inserted where it is not there yet."""
    house = connection.execute(select(Round.house).where(Round.id == round_id)).scalar_one()
    return id_of(connection, Row, {"house": house, "name": name}, "house", "name")
