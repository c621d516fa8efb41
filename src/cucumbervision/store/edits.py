"""Corrections of stops and rounds: moved, renamed, deleted; each is logged and can be undone.

The line itself is changed, since every list reads it; what it said before is in the log. What is
deleted stays in the tables, and is in no list.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from sqlalchemy import insert, select, update

from cucumbervision.errors import StoreConflictError, StoreError
from cucumbervision.store.cells import row_id_of
from cucumbervision.store.check import seal_stops, with_hash
from cucumbervision.store.engine import SIGNED_BY, Database
from cucumbervision.store.records import checked_key
from cucumbervision.store.schema import Action, Round, StopLine

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sqlalchemy import Connection

STOP_EDITS = ("place-stop", "delete-stop")
"""Kinds of action after which a round's views have to be merged anew."""


@dataclass(frozen=True)
class StopPlace:
    """What can be corrected about a stop.

    Parameters
    ----------
    row, side : str, optional
        Row of the house, and side of the row.
    position_m : float, optional
        Along the row.
    step : int, optional
        Its number.
    note : str
        What it is called beside its number.
    mirrored : bool
        Whether positions grow the other way in its pictures than they did when it was measured.
    """

    row: str | None
    side: str | None
    position_m: float | None
    step: int | None
    note: str = ""
    mirrored: bool = False


class Edits(Database):
    """Corrections of stops and rounds. Each method returns its number in the log.

    `by` names the person. All raise `StoreError` where the stop or round is not there.
    """

    def place_stop(self, key: str, place: StopPlace, *, by: str = "") -> int:
        """Say where a stop was taken, and what it is called; its fitted position is forgotten."""
        with self.writing() as connection:
            after = asdict(place)
            row, stop = after.pop("row"), _line(connection, StopLine, key)
            after["row_id"] = row if row is None else row_id_of(connection, stop.round_id, row)
            return _edit(connection, StopLine, stop, "place-stop", after, by)

    def delete_stop(self, key: str, *, by: str = "") -> int:
        """Take a stop with all its fruit out of every list."""
        with self.writing() as connection:
            stop = _line(connection, StopLine, key)
            return _edit(connection, StopLine, stop, "delete-stop", {"deleted": True}, by)

    def rename_round(self, key: str, name: str, *, by: str = "") -> int:
        """Call a round something else."""
        with self.writing() as connection:
            found = _line(connection, Round, key)
            return _edit(connection, Round, found, "rename-round", {"name": name}, by)

    def delete_round(self, key: str, *, by: str = "") -> int:
        """Take a round with all its stops out of the list of rounds."""
        with self.writing() as connection:
            found = _line(connection, Round, key)
            return _edit(connection, Round, found, "delete-round", {"deleted": True}, by)


MEASURE_AGAIN = "measure-again"
"""The kind of action that measures a stop again: the one that is not undone."""


def stop_line(connection: Connection, key: str) -> Any:
    """Return all cells of a stop that was not deleted, and keep others from changing it.

    Raises
    ------
    StoreError
        If it is not there.
    """
    return _line(connection, StopLine, key)


_TABLES: dict[str, Any] = {"stops": StopLine, "rounds": Round}


def _line(connection: Connection, table: Any, key: str) -> Any:
    what = "stop" if table is StopLine else "round"
    query = select(*table.__table__.columns).where(table.key == checked_key(key, what))
    found = connection.execute(query.with_for_update(key_share=True)).one_or_none()
    if found is None or found.deleted:
        raise StoreError(f"{what} {key} is not in the store", remedy=f"see the list of {what}s")
    return found


def _edit(
    connection: Connection, table: Any, line: Any, kind: str, after: dict[str, Any], by: str
) -> int:
    before = {name: getattr(line, name) for name in after}
    details = {"table": table.__tablename__, "key": line.key, "before": before, "after": after}
    round_id = line.id if table is Round else line.round_id
    number = log_action(connection, kind, by, round_id, details=details)
    change_line(connection, details)
    return number


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
    said = {
        "at_s": time.time(),
        "by": by or connection.get_execution_options().get(SIGNED_BY, ""),
        "kind": kind,
        "fruit": list(fruit),
        "details": details or {},
    }
    line = insert(Action).values(**with_hash(Action, said), round_id=round_id, **cells)
    return connection.execute(line.returning(Action.id)).scalar_one()


def change_line(connection: Connection, details: dict[str, Any], *, back: bool = False) -> None:
    """Write an action's `details` into its stop or round; `back` restores the values before it.

    Raises
    ------
    StoreConflictError
        If the line was changed since.
    """
    table = _TABLES[details["table"]]
    old, new = details["before"], details["after"]
    if back:
        old, new = new, old
    now = [getattr(table, name).is_not_distinct_from(value) for name, value in old.items()]
    # Where merging put a stop that is moved no longer holds: the next merging finds it anew.
    fitted = {"fitted_m": None, "fitted_sd_m": None} if "position_m" in new else {}
    line = update(table).where(table.key == details["key"], *now)
    if connection.execute(line.values(**new, **fitted)).rowcount != 1:
        raise StoreConflictError("it was changed again since", remedy="undo the later change first")
    if table is StopLine:
        seal_stops(connection, StopLine.key == details["key"])


def original_name(connection: Connection, round_key: str) -> str | None:
    """Return what a round was called before it was renamed; None where it never was."""
    renamed = (
        select(Action.details)
        .join(Round, Round.id == Action.round_id)
        .where(Round.key == round_key, Action.kind == "rename-round")
        .order_by(Action.id)
        .limit(1)
    )
    details = connection.execute(renamed).scalar()
    return None if details is None else str(details["before"]["name"])
