"""What algorithms say of whole rounds: links, fitted positions, shifts; each run replaces the last.

What somebody did by hand stands: a pair that was linked or parted by hand keeps that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sqlalchemy import delete, insert, select, update

from cucumbervision.errors import StoreError
from cucumbervision.store.manual import FoundFruit, find_fruit, lock_rounds
from cucumbervision.store.schema import Link, Row, Shift, StopLine
from cucumbervision.store.views import LinkKind
from cucumbervision.store.writing import round_id_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sqlalchemy import Connection

    from cucumbervision.store.views import LinkRecord, Position, ShiftRecord

__all__ = ["save_growth", "save_merging"]


def save_merging(
    connection: Connection,
    round_key: str,
    links: Sequence[LinkRecord],
    positions: Mapping[str, Position],
) -> int:
    """Replace what an algorithm said of a round: which detections are one, where stops are.

    Returns
    -------
    int
        How many links were written; those of pairs that were decided by hand were not.
    """
    round_id = round_id_of(connection, round_key)
    lock_rounds(connection, [round_id])
    connection.execute(
        delete(Link).where(
            Link.kind == str(LinkKind.SAME),
            Link.action_id.is_(None),
            Link.ended_by_id.is_(None),
            Link.first_round_id == round_id,
            Link.second_round_id == round_id,
        )
    )
    in_round = StopLine.round_id == round_id
    connection.execute(update(StopLine).where(in_round).values(fitted_m=None, fitted_sd_m=None))
    for key, position in positions.items():
        values = {"fitted_m": position.at_m, "fitted_sd_m": position.sd_m}
        fitted = connection.execute(
            update(StopLine).where(in_round, StopLine.key == key).values(**values)
        )
        if fitted.rowcount != 1:
            raise StoreError(f"stop {key} is not in round {round_key}", remedy="see stops()")
    return _add_links(connection, LinkKind.SAME, links, (round_id, round_id))


def save_growth(
    connection: Connection,
    earlier: str,
    later: str,
    links: Sequence[LinkRecord],
    shifts: Sequence[ShiftRecord],
) -> int:
    """Replace what an algorithm said of the growth between two rounds, and of the rows' shifts.

    Returns
    -------
    int
        How many links were written; those of pairs that were decided by hand were not.
    """
    rounds = round_id_of(connection, earlier), round_id_of(connection, later)
    lock_rounds(connection, rounds)
    connection.execute(
        delete(Link).where(
            Link.kind == str(LinkKind.GROWTH),
            Link.action_id.is_(None),
            Link.ended_by_id.is_(None),
            Link.first_round_id == rounds[0],
            Link.second_round_id == rounds[1],
        )
    )
    connection.execute(
        delete(Shift).where(Shift.earlier_id == rounds[0], Shift.later_id == rounds[1])
    )
    for shift in shifts:
        row = (
            select(Row.id)
            .join(StopLine, StopLine.row_id == Row.id)
            .where(StopLine.round_id == rounds[1], Row.name == shift.row)
            .limit(1)
        )
        row_id = connection.execute(row).scalar()
        if row_id is None:
            raise StoreError(f"round {later} has no row '{shift.row}'", remedy="see stops()")
        cells = {"row_id": row_id, "earlier_id": rounds[0], "later_id": rounds[1]}
        connection.execute(insert(Shift).values(**cells, shift_m=shift.shift_m, sd_m=shift.sd_m))
    return _add_links(connection, LinkKind.GROWTH, links, rounds)


def _add_links(
    connection: Connection,
    kind: LinkKind,
    links: Sequence[LinkRecord],
    rounds: tuple[int, int],
) -> int:
    if not links:
        return 0
    keys = sorted({key for link in links for key in (link.first, link.second)})
    fruit = dict(zip(keys, find_fruit(connection, keys), strict=True))
    decided = _decided(connection, rounds)
    lines = {}
    for link in links:
        first, second = fruit[link.first], fruit[link.second]
        _check_link(link, first, second, kind, rounds)
        pair = frozenset((first.id, second.id))
        if pair not in decided:
            lines[pair] = {
                "kind": str(kind),
                "first_id": first.id,
                "second_id": second.id,
                "first_round_id": rounds[0],
                "second_round_id": rounds[1],
                "score": link.score,
            }
    if lines:
        connection.execute(insert(Link), list(lines.values()))
    return len(lines)


def _check_link(
    link: LinkRecord,
    first: FoundFruit,
    second: FoundFruit,
    kind: LinkKind,
    rounds: tuple[int, int],
) -> None:
    if (first.round_id, second.round_id) != rounds or first.id == second.id or link.kind != kind:
        raise StoreError(
            f"the link of {link.first} and {link.second} is not '{kind}' of these rounds",
            remedy="link two fruit of the rounds named, the earlier first",
        )


def _decided(connection: Connection, rounds: tuple[int, int]) -> set[frozenset[int]]:
    query = select(Link.first_id, Link.second_id).where(
        Link.action_id.is_not(None),
        Link.ended_by_id.is_(None),
        Link.first_round_id.in_(rounds),
        Link.second_round_id.in_(rounds),
    )
    return {frozenset((first, second)) for first, second in connection.execute(query)}
