"""Results of merging and linking: links, fitted positions, shifts, and lengths from all views."""

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
    insert_all,
    insert_new,
    round_id_of,
)
from cucumbervision.store.check import change, with_hash
from cucumbervision.store.corrections import find_detections, lock_rounds
from cucumbervision.store.engine import Database
from cucumbervision.store.links import LinkKind
from cucumbervision.store.records import JointRecord, record_json
from cucumbervision.store.schema import JointLine, LinkLine, RoundLine, StopLine

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from sqlalchemy import Connection

    from cucumbervision.store.links import LinkRecord, Position


_LISTED_NAMES = ("key", "first", "views", "reason", "record")
_LISTED = columns_of(JointLine, _LISTED_NAMES)


class Merging(Database):
    """Saves what merging and linking found. Each method is one transaction."""

    def save_merging(
        self,
        round_key: str,
        links: Sequence[LinkRecord],
        positions: Mapping[str, Position] | None = None,
    ) -> int:
        """Replace a round's links of `LinkKind.SAME` and its stops' fitted positions.

        Returns
        -------
        int
            How many links were written; those of pairs that were decided by hand were not.
        """
        with self.writing() as connection:
            round_id = round_id_of(connection, round_key)
            lock_rounds(connection, [round_id])
            _forget_links(connection, LinkKind.SAME, (round_id, round_id))
            in_round = StopLine.round_id == round_id
            nowhere = {"fitted_m": None, "fitted_sd_m": None}
            change(connection, StopLine, in_round, **nowhere)
            for key, position in (positions or {}).items():
                values = {"fitted_m": position.at_m, "fitted_sd_m": position.sd_m}
                if change(connection, StopLine, and_(in_round, StopLine.key == key), **values) != 1:
                    raise StoreError(
                        f"stop {key} is not in round {round_key}", remedy="see stops()"
                    )
            return _add_links(connection, LinkKind.SAME, links, (round_id, round_id))

    def save_growth(self, earlier: str, later: str, links: Sequence[LinkRecord]) -> int:
        """Replace the links of `LinkKind.GROWTH` between two rounds.

        Returns
        -------
        int
            How many links were written; those of pairs that were decided by hand were not.
        """
        with self.writing() as connection:
            rounds = round_id_of(connection, earlier), round_id_of(connection, later)
            lock_rounds(connection, rounds)
            _forget_links(connection, LinkKind.GROWTH, rounds)
            return _add_links(connection, LinkKind.GROWTH, links, rounds)

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
                insert_new(connection, JointLine, with_hash(JointLine, cells), "key")

    def joint(self, round_key: str) -> dict[str, JointRecord]:
        """Return a round's joint measurements by their keys, without paths and poses."""
        query = (
            select(*_LISTED)
            .join(RoundLine, RoundLine.id == JointLine.round_id)
            .where(RoundLine.key == round_key)
        )
        with self.reading() as connection:
            rows = cells_of(connection, query)
            with decoding(connection):
                return {row[0]: _joint_of(row) for row in rows}

    def joint_drawing(self, round_key: str, key: str) -> JointRecord:
        """Return one joint measurement with everything: the tube's path, and the cameras' poses.

        Raises
        ------
        StoreError
            If it is not there.
        """
        query = (
            select(*_LISTED, JointLine.drawing)
            .join(RoundLine, RoundLine.id == JointLine.round_id)
            .where(and_(RoundLine.key == round_key, JointLine.key == key))
        )
        with self.reading() as connection:
            rows = cells_of(connection, query)
            if not rows:
                raise StoreError(f"joint measurement {key} is not there", remedy="merge again")
            with decoding(connection):
                *cells, drawing = rows[0]
                return _joint_of(cells, drawing)


def _joint_of(row: Sequence[Any], drawing: Mapping[str, Any] | None = None) -> JointRecord:
    """Return a joint measurement from its cells; with its drawing, which lists leave out."""
    values = dict(zip(_LISTED_NAMES, row, strict=True))
    if drawing is not None:
        values["poses"] = drawing["poses"]
        if values["record"] is not None:
            values["record"] = {**values["record"], "methods": drawing["methods"]}
    return _reader().validate_python(values)


@lru_cache(maxsize=1)
def _reader() -> TypeAdapter[JointRecord]:
    return TypeAdapter(JointRecord)


def _forget_links(connection: Connection, kind: LinkKind, rounds: tuple[int, int]) -> None:
    """Remove the links that an algorithm made between two rounds, or within one."""
    connection.execute(
        delete(LinkLine).where(
            LinkLine.kind == str(kind),
            LinkLine.action_id.is_(None),
            LinkLine.ended_by_id.is_(None),
            LinkLine.first_round_id == rounds[0],
            LinkLine.second_round_id == rounds[1],
        )
    )


def _add_links(
    connection: Connection, kind: LinkKind, links: Sequence[LinkRecord], rounds: tuple[int, int]
) -> int:
    if not links:
        return 0
    keys = sorted({key for link in links for key in (link.first, link.second)})
    found = dict(zip(keys, find_detections(connection, keys), strict=True))
    decided = _decided_pairs(connection, rounds)
    lines = {}
    for link in links:
        first, second = found[link.first], found[link.second]
        between = (first.round_id, second.round_id)
        if between != rounds or first.id == second.id or link.kind != kind:
            raise StoreError(
                f"the link of {link.first} and {link.second} is not '{kind}' of these rounds",
                remedy="link two fruit of the rounds named, the earlier first",
            )
        pair = frozenset((first.id, second.id))
        if pair not in decided:
            cells = {
                "kind": str(kind),
                "first_id": first.id,
                "second_id": second.id,
                "first_round_id": rounds[0],
                "second_round_id": rounds[1],
                "score": link.score,
            }
            lines[pair] = with_hash(LinkLine, cells)
    insert_all(connection, LinkLine, list(lines.values()))
    return len(lines)


def _decided_pairs(connection: Connection, rounds: tuple[int, int]) -> set[frozenset[int]]:
    query = select(LinkLine.first_id, LinkLine.second_id).where(
        LinkLine.action_id.is_not(None),
        LinkLine.ended_by_id.is_(None),
        LinkLine.first_round_id.in_(rounds),
        LinkLine.second_round_id.in_(rounds),
    )
    return {frozenset((first, second)) for first, second in connection.execute(query)}
