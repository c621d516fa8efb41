"""What people do by hand: marks, merges, corrections; each logged, each to be taken back."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, NamedTuple

from sqlalchemy import insert, or_, select, update
from sqlalchemy.exc import IntegrityError

from cucumbervision.errors import StoreConflictError, StoreError
from cucumbervision.store.groups import group_fruit
from cucumbervision.store.reading import link_records
from cucumbervision.store.records import FruitRecord, checked_key, record_json
from cucumbervision.store.schema import Action, FruitLine, Link, Mark, Round
from cucumbervision.store.views import LinkKind, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sqlalchemy import Connection

__all__ = [
    "FoundFruit",
    "correct",
    "find_fruit",
    "link",
    "lock_rounds",
    "merge",
    "pair_of",
    "pick",
    "set_verdict",
    "undo",
    "unmerge",
]


_AT_ONCE = 10_000  # SQLite takes 32,766 values in one command, PostgreSQL 65,535


class FoundFruit(NamedTuple):
    """Where a fruit is in the tables."""

    key: str
    id: int
    round_id: int


def find_fruit(connection: Connection, keys: Sequence[str]) -> list[FoundFruit]:
    """Find fruit by their keys, in that order, and keep others from marking or linking them.

    Raises
    ------
    StoreError
        If one is not there, or none was named.
    """
    wanted = [checked_key(key, "fruit") for key in keys]
    if not wanted:
        raise StoreError("no fruit was named", remedy="name at least one")
    found: dict[str, FoundFruit] = {}
    for at in range(0, len(wanted), _AT_ONCE):
        query = select(FruitLine.key, FruitLine.id, FruitLine.round_id).where(
            FruitLine.key.in_(wanted[at : at + _AT_ONCE])
        )
        found.update({row.key: FoundFruit(*row) for row in connection.execute(query)})
    missing = next((key for key in wanted if key not in found), None)
    if missing is not None:
        raise StoreError(f"fruit {missing} is not in the store", remedy="look it up in fruit()")
    lock_rounds(connection, {row.round_id for row in found.values()})
    return [found[key] for key in wanted]


def lock_rounds(connection: Connection, round_ids: Iterable[int]) -> None:
    """Keep others from marking or linking in rounds until the transaction ends.

    Stops can still be saved. In SQLite the whole transaction is alone anyway.
    """
    query = select(Round.id).where(Round.id.in_(sorted(set(round_ids)))).order_by(Round.id)
    connection.execute(query.with_for_update(key_share=True))


def set_verdict(
    connection: Connection, keys: Sequence[str], verdict: Verdict | None, by: str
) -> int:
    """Accept or reject fruit, or take the verdict away; give the log's line."""
    kinds = {Verdict.ACCEPTED: "accept", Verdict.REJECTED: "reject", None: "clear"}
    fruit = find_fruit(connection, keys)
    action = _log(connection, kinds[verdict], by, fruit)
    _mark(connection, action, fruit, "verdict", verdict, {})
    return action


def pick(connection: Connection, keys: Sequence[str], at_s: float | None, by: str) -> int:
    """Say when fruit were picked, or with None that they were not; give the log's line."""
    fruit = find_fruit(connection, keys)
    details = {} if at_s is None else {"at_s": at_s}
    action = _log(connection, "unpick" if at_s is None else "pick", by, fruit, details)
    _mark(connection, action, fruit, "picked", None if at_s is None else "picked", details)
    return action


def correct(connection: Connection, key: str, fruit: FruitRecord, by: str) -> int:
    """Let a fruit measured anew, with another mask, stand for the first measurement.

    Raises
    ------
    StoreConflictError
        If its number is another fruit's.
    """
    found = find_fruit(connection, [key])
    query = select(FruitLine.number).where(FruitLine.id == found[0].id)
    if connection.execute(query).scalar_one() != fruit.number:
        raise StoreConflictError(
            f"fruit {key} has another number than {fruit.number}",
            remedy="measure the fruit that the mask belongs to",
        )
    action = _log(connection, "correct", by, found)
    _mark(connection, action, found, "mask", "corrected", record_json(fruit))
    return action


def link(
    connection: Connection, kind: LinkKind, pairs: Sequence[tuple[str, str]], name: str, by: str
) -> int:
    """Link pairs of fruit by hand, or say that they are two; give the log's line.

    Whatever linked a pair before, in either order, ends.
    """
    keys = list(dict.fromkeys(key for pair in pairs for key in pair))
    fruit = {row.key: row for row in find_fruit(connection, keys)}
    action = _log(connection, name, by, list(fruit.values()), {"kind": str(kind)})
    for pair in pairs:
        first, second = (fruit[checked_key(key, "fruit")] for key in pair)
        _check_pair(kind, first, second)
        _end(connection, Link, action, pair_of(first.id, second.id))
        connection.execute(
            insert(Link).values(
                kind=str(kind),
                first_id=first.id,
                second_id=second.id,
                first_round_id=first.round_id,
                second_round_id=second.round_id,
                action_id=action,
            )
        )
    return action


def _check_pair(kind: LinkKind, first: FoundFruit, second: FoundFruit) -> None:
    within = first.round_id == second.round_id
    places = {LinkKind.SAME: within, LinkKind.GROWTH: not within, LinkKind.APART: True}
    if first.id == second.id or not places[kind]:
        raise StoreError(
            f"{first.key} and {second.key} are not two fruit that can be linked so",
            remedy="merge two of one round, link growth between two rounds",
        )


def merge(connection: Connection, first: str, second: str, by: str) -> int:
    """Say that two detections are one fruit, and with them their groups; give the log's line."""
    a, b = find_fruit(connection, [first, second])
    groups = [_group(connection, one) for one in (a, b)]
    action = link(connection, LinkKind.SAME, [(first, second)], "merge", by)
    ids = [[one.id for one in find_fruit(connection, sorted(group))] for group in groups]
    _end(connection, Link, action, _parted(*ids))
    return action


def _parted(some: Sequence[int], others: Sequence[int]) -> Any:
    there = Link.first_id.in_(some) & Link.second_id.in_(others)
    back = Link.first_id.in_(others) & Link.second_id.in_(some)
    return (Link.kind == str(LinkKind.APART)) & or_(there, back)


def _group(connection: Connection, fruit: FoundFruit) -> frozenset[str]:
    query = select(Round.key).where(Round.id == fruit.round_id)
    links = link_records(connection, connection.execute(query).scalar_one())
    keys = {fruit.key, *(end for one in links for end in (one.first, one.second))}
    return group_fruit(keys, links)[fruit.key]


def unmerge(connection: Connection, key: str, by: str) -> int:
    """Part a detection from all that it is merged with; give the log's line.

    Raises
    ------
    StoreError
        If it is merged with none.
    """
    found = find_fruit(connection, [key])[0]
    others = sorted(_group(connection, found) - {found.key})
    if not others:
        raise StoreError(f"fruit {found.key} is merged with none", remedy="see its group")
    pairs = [(found.key, other) for other in others]
    return link(connection, LinkKind.APART, pairs, "unmerge", by)


def undo(connection: Connection, by: str, number: int | None, round_id: int | None) -> int:
    """Take back an action: the newest that has not been taken back, or the one named.

    Raises
    ------
    StoreError
        If there is none.
    StoreConflictError
        If a later action stands on it, or it was taken back already.
    """
    action = _action_to_undo(connection, number, round_id)
    lock_rounds(connection, [action.round_id])
    for table in (Mark, Link):
        ended = select(table.id).where(table.action_id == action.id, table.ended_by_id.is_not(None))
        if connection.execute(ended.limit(1)).first() is not None:
            raise _stands_on(action.id)
    line = insert(Action).values(
        at_s=time.time(),
        by=by,
        kind="undo",
        round_id=action.round_id,
        fruit=action.fruit,
        details={"kind": action.kind},
        undoes_id=action.id,
    )
    try:
        number = connection.execute(line.returning(Action.id)).scalar_one()
        for table in (Mark, Link):
            _end(connection, table, number, table.action_id == action.id)
            begun_again = update(table).where(table.ended_by_id == action.id)
            connection.execute(begun_again.values(ended_by_id=None))
    except IntegrityError:  # something newer stands where the old would stand again
        raise _stands_on(action.id) from None
    return number


def _action_to_undo(connection: Connection, number: int | None, round_id: int | None) -> Any:
    undone = select(Action.undoes_id).where(Action.undoes_id.is_not(None))
    query = select(Action.id, Action.kind, Action.round_id, Action.fruit).where(
        Action.kind != "undo", Action.id.not_in(undone)
    )
    if number is not None:
        query = query.where(Action.id == number)
    if round_id is not None:
        query = query.where(Action.round_id == round_id)
    found = connection.execute(query.order_by(Action.id.desc()).limit(1)).one_or_none()
    if found is None:
        which = "nothing" if number is None else f"no action {number}"
        raise StoreError(f"there is {which} to take back", remedy="see the log")
    return found


def _stands_on(number: int) -> StoreConflictError:
    return StoreConflictError(
        f"a later action stands on action {number}", remedy="take the later one back first"
    )


def _log(
    connection: Connection,
    kind: str,
    by: str,
    fruit: Sequence[FoundFruit],
    details: dict[str, Any] | None = None,
) -> int:
    line = insert(Action).values(
        at_s=time.time(),
        by=by,
        kind=kind,
        round_id=fruit[-1].round_id,
        fruit=[one.key for one in fruit],
        details=details or {},
    )
    return connection.execute(line.returning(Action.id)).scalar_one()


def _mark(
    connection: Connection,
    action: int,
    fruit: Sequence[FoundFruit],
    slot: str,
    value: str | None,
    details: dict[str, Any],
) -> None:
    ids = sorted({one.id for one in fruit})
    _end(connection, Mark, action, (Mark.fruit_id.in_(ids)) & (Mark.slot == slot))
    if value is not None:
        connection.execute(
            insert(Mark),
            [
                {
                    "fruit_id": fruit_id,
                    "slot": slot,
                    "value": str(value),
                    "details": details,
                    "action_id": action,
                }
                for fruit_id in ids
            ],
        )


def _end(connection: Connection, table: type[Mark] | type[Link], action: int, which: Any) -> None:
    ending = update(table).where(table.ended_by_id.is_(None), which)
    connection.execute(ending.values(ended_by_id=action))


def pair_of(a: int, b: int) -> Any:
    """Say which links are about two fruit, in either order."""
    return or_(
        (Link.first_id == a) & (Link.second_id == b), (Link.first_id == b) & (Link.second_id == a)
    )
