"""A stop that is measured again: what was measured before is put aside, what people said stays.

The stop keeps its key and place, and a fruit that is found again its key, marks and links. What was
measured before stays in the tables, under a deleted stop of its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sqlalchemy import insert, or_, select, update

from cucumbervision.store.records import key_of, new_key, record_json
from cucumbervision.store.schema import (
    CaptureLine,
    DetectionLine,
    Link,
    Mark,
    StopArtifact,
    StopLine,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sqlalchemy import Connection

    from cucumbervision.store.records import DetectionRecord


def put_aside(connection: Connection, line: Any) -> dict[str, int]:
    """Move a stop's captures to a deleted stop, and return its fruit's numbers by their old keys.

    Parameters
    ----------
    connection : Connection
        In a transaction.
    line : Row
        The stop's line, all columns.
    """
    cells = {**line._mapping, "key": new_key(), "deleted": True}
    del cells["id"]
    aside = connection.execute(insert(StopLine).values(**cells).returning(StopLine.id)).scalar_one()
    for table in (CaptureLine, StopArtifact):
        moved = update(table).where(table.stop_id == line.id)
        connection.execute(moved.values(stop_id=aside))
    old = connection.execute(
        select(DetectionLine.key, DetectionLine.id)
        .join(CaptureLine, CaptureLine.id == DetectionLine.capture_id)
        .where(CaptureLine.stop_id == aside)
    ).all()
    for one in old:
        named = update(DetectionLine).where(DetectionLine.id == one.id)
        connection.execute(named.values(key=key_of(cells["key"], one.key)))
    return {line.key: line.id for line in old}


def carry_over(
    connection: Connection, old: Mapping[str, int], corrected: Mapping[str, DetectionRecord]
) -> None:
    """Give what people and algorithms said of fruit to those that have their keys now.

    Parameters
    ----------
    connection : Connection
        In the same transaction.
    old : mapping of str to int
        Of `put_aside`.
    corrected : mapping of str to DetectionRecord
        Fruit of which a person corrected the mask, as measured again with it.
    """
    found = select(DetectionLine.key, DetectionLine.id).where(DetectionLine.key.in_(old))
    for key, new in connection.execute(found).all():
        was = old[key]
        # A correction that was itself replaced stays with what it was measured from.
        current = or_(Mark.slot != "mask", Mark.ended_by_id.is_(None))
        marks = update(Mark).where(Mark.fruit_id == was, current)
        connection.execute(marks.values(fruit_id=new))
        for end in (Link.first_id, Link.second_id):
            connection.execute(update(Link).where(end == was).values({end: new}))
        standing = (Mark.fruit_id == new, Mark.slot == "mask", Mark.ended_by_id.is_(None))
        if key in corrected:
            again = update(Mark).where(*standing)
            connection.execute(again.values(details=record_json(corrected[key])))
