"""What all views of a fruit together were found to say: kept beside the single detections."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter
from sqlalchemy import and_, delete, select

from cucumbervision.errors import StoreError
from cucumbervision.store.cells import (
    cells_of,
    columns_of,
    decoding,
    detection_from_json,
    insert_new,
)
from cucumbervision.store.corrections import lock_rounds
from cucumbervision.store.engine import Database
from cucumbervision.store.queries import round_id_of
from cucumbervision.store.records import JointRecord, MethodRecord, record_json
from cucumbervision.store.schema import JointLine, Round

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence


_LISTED = columns_of(JointLine, ("key", "first", "views", "reason", "record"))


class JointRecords(Database):
    """Saves and reads joint measurements. Each method is one transaction."""

    def save_joint(
        self, round_key: str, records: Sequence[JointRecord], keep: Collection[str]
    ) -> None:
        """Add joint measurements of a round; of the older ones only those of some keys stay."""
        with self.writing() as connection:
            round_id = round_id_of(connection, round_key)
            lock_rounds(connection, [round_id])
            there = select(JointLine.key).where(JointLine.round_id == round_id)
            stays = {*keep, *(one.key for one in records)}
            gone = [key for key in connection.execute(there).scalars() if key not in stays]
            for key in gone:
                connection.execute(delete(JointLine).where(JointLine.key == key))
            for one in records:
                methods = [asdict(method) for method in one.record.methods] if one.record else []
                drawing = {"methods": methods, "poses": {k: list(v) for k, v in one.poses.items()}}
                cells = {
                    "key": one.key,
                    "round_id": round_id,
                    "first": one.first,
                    "views": one.views,
                    "reason": one.reason,
                    "record": one.record and record_json(replace(one.record, methods=())),
                    "drawing": drawing,
                }
                insert_new(connection, JointLine, cells, "key")

    def joint(self, round_key: str) -> dict[str, JointRecord]:
        """Return a round's joint measurements by their keys, without paths and poses."""
        query = (
            select(*_LISTED)
            .join(Round, Round.id == JointLine.round_id)
            .where(Round.key == round_key)
        )
        with self.reading() as connection:
            rows = cells_of(connection, query)
            with decoding(connection):
                return {row[0]: _record(*row) for row in rows}

    def joint_drawing(self, round_key: str, key: str) -> JointRecord:
        """Return one joint measurement with everything: the tube's path, and the cameras' poses.

        Raises
        ------
        StoreError
            If it is not there.
        """
        query = (
            select(*_LISTED, JointLine.drawing)
            .join(Round, Round.id == JointLine.round_id)
            .where(and_(Round.key == round_key, JointLine.key == key))
        )
        with self.reading() as connection:
            rows = cells_of(connection, query)
            if not rows:
                raise StoreError(f"joint measurement {key} is not there", remedy="merge again")
            with decoding(connection):
                *cells, drawing = rows[0]
                return _with_drawing(_record(*cells), drawing)


def _record(key: str, first: str, views: int, reason: str, record: Any) -> JointRecord:
    return JointRecord(key, first, views, reason, record and detection_from_json(record))


def _with_drawing(one: JointRecord, drawing: Any) -> JointRecord:
    poses = {key: tuple(map(float, numbers)) for key, numbers in drawing["poses"].items()}
    if one.record is None:
        return replace(one, poses=poses)
    record = replace(one.record, methods=_reader_of_methods().validate_python(drawing["methods"]))
    return replace(one, poses=poses, record=record)


@lru_cache(maxsize=1)
def _reader_of_methods() -> TypeAdapter[tuple[MethodRecord, ...]]:
    return TypeAdapter(tuple[MethodRecord, ...])
