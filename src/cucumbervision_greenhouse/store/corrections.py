"""Corrections by hand: of fruit, stops and rounds; each is logged and can be undone.

Corrections of a stop or round change its own line, which every list reads; the previous values are
in the log. Deleted objects stay in the tables and are left out of all lists.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from sqlalchemy import and_, delete, func, insert, or_, select
from sqlalchemy.exc import IntegrityError

from cucumbervision.errors import StoreConflictError, StoreError
from cucumbervision.names import checked_name, house_key, same_house
from cucumbervision_greenhouse.store.cells import change, round_id_of, row_id_of
from cucumbervision_greenhouse.store.engine import DEVICE, SIGNED_BY, Database
from cucumbervision_greenhouse.store.links import LinkKind, group_detections
from cucumbervision_greenhouse.store.queries import NOT_UNDONE, links_of
from cucumbervision_greenhouse.store.records import DetectionRecord, checked_key, record_json
from cucumbervision_greenhouse.store.schema import (
    ADDED,
    IS_ACTIVE,
    Action,
    DetectionLine,
    LinkLine,
    Mark,
    RoundLine,
    StopLine,
)
from cucumbervision_greenhouse.store.stop_content import check_place
from cucumbervision_greenhouse.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sqlalchemy import Connection


_AT_ONCE = 10_000  # SQLite takes 32,766 values in one command, PostgreSQL 65,535


TAKE_BACK = "take-back-stop"
"""The kind of action that deletes a stop because its press was taken back."""
MOVE_ROUND = "move-round"
"""The kind of action that puts a round into another house."""
STOP_EDITS = ("place-stop", "delete-stop", TAKE_BACK)
"""Kinds of action after which a round's views must be merged again."""


@dataclass(frozen=True)
class StopPlace:
    """The correctable values of a stop.

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


class Corrections(Database):
    """Corrections of fruit, stops and rounds. Each method returns its number in the log.

    The log names who the store is signed by (`Database.signed`). All raise `StoreError` where a
    detection, stop or round is not there. Those that are told what was `seen` before raise
    `StoreConflictError` where somebody else has changed it since.
    """

    def set_verdict(self, fruit: Sequence[str], verdict: Verdict | None) -> int:
        """Accept or reject detections; None removes the verdict."""
        kinds = {Verdict.ACCEPTED: "accept", Verdict.REJECTED: "reject", None: "clear"}
        with self.writing() as connection:
            detections = find_detections(connection, fruit)
            action = _log(connection, kinds[verdict], detections)
            _mark(connection, action, detections, "verdict", verdict)
        return action

    def pick(self, fruit: Sequence[str], *, at_s: float | None = None) -> int:
        """Record that fruit were picked at a time, by default now."""
        details = {"at_s": time.time() if at_s is None else at_s}
        with self.writing() as connection:
            detections = find_detections(connection, fruit)
            action = _log(connection, "pick", detections, details)
            _mark(connection, action, detections, "picked", "picked", details)
        return action

    def unpick(self, fruit: Sequence[str]) -> int:
        """Record that fruit were not picked."""
        with self.writing() as connection:
            detections = find_detections(connection, fruit)
            action = _log(connection, "unpick", detections)
            _mark(connection, action, detections, "picked", None)
        return action

    def correct(self, key: str, record: DetectionRecord) -> int:
        """Replace a measurement by one with a corrected mask; the first one is kept.

        Raises
        ------
        StoreConflictError
            If its number is another detection's.
        """
        with self.writing() as connection:
            detections = find_detections(connection, [key])
            query = select(DetectionLine.number).where(DetectionLine.id == detections[0].id)
            if connection.execute(query).scalar_one() != record.number:
                raise StoreConflictError(
                    f"fruit {key} has another number than {record.number}",
                    remedy="measure the fruit that the mask belongs to",
                )
            action = _log(connection, "correct", detections)
            _mark(connection, action, detections, "mask", "corrected", record_json(record))
        return action

    def merge(self, first: str, second: str) -> int:
        """Record that two detections of a round are one fruit, with all that each is merged with.

        Earlier decisions that separated the two groups end.
        """
        with self.writing() as connection:
            a, b = find_detections(connection, [first, second])
            groups = [_group_of(connection, key) for key in (a, b)]
            action = _link(connection, LinkKind.SAME, [(first, second)], "merge")
            first_ids, second_ids = (
                [detection.id for detection in find_detections(connection, sorted(group))]
                for group in groups
            )
            forward = LinkLine.first_id.in_(first_ids) & LinkLine.second_id.in_(second_ids)
            backward = LinkLine.first_id.in_(second_ids) & LinkLine.second_id.in_(first_ids)
            parted = and_(LinkLine.kind == str(LinkKind.APART), or_(forward, backward))
            _end(connection, LinkLine, action, parted)
        return action

    def unmerge(self, key: str) -> int:
        """Record that a detection is another fruit than all that it is merged with.

        Raises
        ------
        StoreError
            If it is merged with none.
        """
        with self.writing() as connection:
            detection = find_detections(connection, [key])[0]
            members = sorted(_group_of(connection, detection) - {detection.key})
            if not members:
                raise StoreError(
                    f"fruit {detection.key} is merged with none", remedy="see its group"
                )
            pairs = [(detection.key, member) for member in members]
            return _link(connection, LinkKind.APART, pairs, "unmerge")

    def link_growth(self, earlier: str, later: str) -> int:
        """Record that a fruit of a later round is this fruit of an earlier one."""
        with self.writing() as connection:
            return _link(connection, LinkKind.GROWTH, [(earlier, later)], "link-growth")

    def unlink_growth(self, earlier: str, later: str) -> int:
        """Record that two fruit of different rounds are not one."""
        with self.writing() as connection:
            return _link(connection, LinkKind.APART, [(earlier, later)], "unlink-growth")

    def place_stop(self, key: str, place: StopPlace, seen: StopPlace | None = None) -> int:
        """Set where a stop was taken, and its name; its fitted position is discarded.

        Raises
        ------
        NameRefusedError
            If its row, side or name is none.
        """
        check_place(place)
        with self.writing() as connection:
            stop = line_of(connection, StopLine, key)
            after, before = (
                None if x is None else _place_cells(connection, stop.round_id, x)
                for x in (place, seen)
            )
            return _edit(connection, StopLine, stop, "place-stop", after or {}, before)

    def delete_stop(self, key: str, *, taken_back: bool = False) -> int:
        """Take a stop with all its fruit out of every list.

        `taken_back` logs that its press was taken back, which is no new thing to be undone before
        what was done earlier.
        """
        kind = TAKE_BACK if taken_back else "delete-stop"
        with self.writing() as connection:
            stop = line_of(connection, StopLine, key)
            return _edit(connection, StopLine, stop, kind, {"deleted": True})

    def rename_round(self, key: str, name: str, seen: str | None = None) -> int:
        """Rename a round.

        Raises
        ------
        NameRefusedError
            If that is no name.
        """
        name = checked_name(name, "round's name")
        with self.writing() as connection:
            line = line_of(connection, RoundLine, key)
            before = None if seen is None else {"name": seen}
            return _edit(connection, RoundLine, line, "rename-round", {"name": name}, before)

    def move_rounds(self, keys: Sequence[str], house: str, seen: str | None = None) -> int:
        """Move rounds to a house: all of one house to rename it, or to merge it with another.

        The house is the known one where the names differ by no more than case, spaces or the word
        'house', unless only the spelling changes. Links of growth that were computed to rounds of
        other houses are removed.

        Returns
        -------
        int
            How many rounds were moved; one action each.

        Raises
        ------
        NameRefusedError
            If that is no name.
        """
        house = checked_name(house, "house")
        with self.writing() as connection:
            # In one order: two that move the same rounds would wait for each other.
            lock_rounds(connection, [round_id_of(connection, key) for key in keys])
            lines = [line_of(connection, RoundLine, key) for key in keys]
            houses = select(RoundLine.house).where(~RoundLine.deleted, RoundLine.key.not_in(keys))
            house = same_house(house, connection.execute(houses.order_by(RoundLine.id)).scalars())
            moved = [line for line in lines if line.house != house]
            for line in moved:
                before = None if seen is None else {"house": seen}
                _edit(connection, RoundLine, line, MOVE_ROUND, {"house": house}, before)
            _forget_other_houses(connection, [line.id for line in moved])
        return len(moved)

    def delete_round(self, key: str) -> int:
        """Take a round with all its stops out of the list of rounds."""
        with self.writing() as connection:
            line = line_of(connection, RoundLine, key)
            return _edit(connection, RoundLine, line, "delete-round", {"deleted": True})

    def undo(self, round_key: str | None = None, *, number: int | None = None) -> int:
        """Undo an action: the round's newest that has not been undone, or the one named.

        Raises
        ------
        StoreConflictError
            If a later action depends on it.
        StoreError
            If there is nothing to undo.
        """
        with self.writing() as connection:
            action = _action_to_undo(connection, number, round_key)
            lock_rounds(connection, [action.round_id])
            for table in (Mark, LinkLine):
                ended = select(table.id).where(
                    table.action_id == action.id, table.ended_by_id.is_not(None)
                )
                if connection.execute(ended.limit(1)).first() is not None:
                    raise _blocked_by_later(action.id)
            try:
                made = log_action(
                    connection,
                    "undo",
                    action.round_id,
                    action.fruit,
                    {"kind": action.kind},
                    undoes_id=action.id,
                )
                for table in (Mark, LinkLine):
                    _end(connection, table, made, table.action_id == action.id)
                    change(connection, table, table.ended_by_id == action.id, ended_by_id=None)
                if "before" in action.details:
                    change_line(connection, action.details, restore=True)
                    if action.kind == MOVE_ROUND:
                        _forget_other_houses(connection, [action.round_id])
            except IntegrityError:  # a newer mark has replaced it
                raise _blocked_by_later(action.id) from None
        return made

    def restore_round(self, key: str) -> int:
        """Put a deleted round back into the list of rounds.

        Raises
        ------
        StoreError
            If it was not deleted.
        """
        with self.reading() as connection:
            undone = select(Action.undoes_id).where(Action.undoes_id.is_not(None))
            deleted = select(func.max(Action.id)).where(
                Action.round_id == round_id_of(connection, key),
                Action.kind == "delete-round",
                Action.id.not_in(undone),
            )
            number = connection.execute(deleted).scalar()
        if number is None:
            raise StoreError(f"round {key} is not deleted", remedy="see the list of rounds")
        return self.undo(number=number)


class DetectionId(NamedTuple):
    """Where a detection is in the tables."""

    key: str
    id: int
    round_id: int


def find_detections(connection: Connection, keys: Sequence[str]) -> list[DetectionId]:
    """Find detections by their keys, in that order, and keep others from marking or linking them.

    Raises
    ------
    StoreError
        If one is not there, or none was named.
    """
    fruit_keys = [checked_key(key, "fruit") for key in keys]
    if not fruit_keys:
        raise StoreError("no fruit was named", remedy="name at least one")
    detections: dict[str, DetectionId] = {}
    for start in range(0, len(fruit_keys), _AT_ONCE):
        query = select(DetectionLine.key, DetectionLine.id, DetectionLine.round_id).where(
            DetectionLine.key.in_(fruit_keys[start : start + _AT_ONCE]), IS_ACTIVE
        )
        detections.update({row.key: DetectionId(*row) for row in connection.execute(query)})
    missing = next((key for key in fruit_keys if key not in detections), None)
    if missing is not None:
        raise StoreError(
            "fruit {key} is not in the store", remedy="look it up in detections()", key=missing
        )
    lock_rounds(connection, {row.round_id for row in detections.values()})
    return [detections[key] for key in fruit_keys]


def mark_added(connection: Connection, key: str, *, accept: bool = True) -> int:
    """Log that a fruit was added by hand, and accept it; it counts until that is undone."""
    detections = find_detections(connection, [key])
    action = _log(connection, "add", detections)
    _mark(connection, action, detections, ADDED, "by-hand")
    if accept:
        _mark(connection, action, detections, "verdict", Verdict.ACCEPTED)
    return action


def lock_rounds(connection: Connection, round_ids: Iterable[int]) -> None:
    """Lock rounds against other marks and links until the transaction ends.

    Stops can still be saved. In SQLite a writing transaction is alone anyway.
    """
    query = (
        select(RoundLine.id).where(RoundLine.id.in_(sorted(set(round_ids)))).order_by(RoundLine.id)
    )
    connection.execute(query.with_for_update(key_share=True))


def _link(
    connection: Connection, kind: LinkKind, pairs: Sequence[tuple[str, str]], name: str
) -> int:
    """Link or separate pairs by hand; earlier links of a pair, in either order, end."""
    keys = list(dict.fromkeys(key for pair in pairs for key in pair))
    fruit = {row.key: row for row in find_detections(connection, keys)}
    action = _log(connection, name, list(fruit.values()), {"kind": str(kind)})
    for pair in pairs:
        first, second = (fruit[checked_key(key, "fruit")] for key in pair)
        within = first.round_id == second.round_id
        places = {LinkKind.SAME: within, LinkKind.GROWTH: not within, LinkKind.APART: True}
        if first.id == second.id or not places[kind]:
            raise StoreError(
                "{first} and {second} are not two fruit that can be linked so",
                remedy="merge two of one round, link growth between two rounds",
                first=first.key,
                second=second.key,
            )
        ends = (first.id, second.id)
        _end(
            connection, LinkLine, action, LinkLine.first_id.in_(ends) & LinkLine.second_id.in_(ends)
        )
        cells = {
            "kind": str(kind),
            "first_id": first.id,
            "second_id": second.id,
            "first_round_id": first.round_id,
            "second_round_id": second.round_id,
            "action_id": action,
        }
        connection.execute(insert(LinkLine).values(**cells))
    return action


def forget_links(connection: Connection, kind: LinkKind, rounds: tuple[int, int]) -> None:
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


def _forget_other_houses(connection: Connection, round_ids: Sequence[int]) -> None:
    """Remove the links of growth that an algorithm made from rounds to those of other houses."""
    house_query = select(RoundLine.id, RoundLine.house)
    house_of = {number: house_key(house) for number, house in connection.execute(house_query)}
    ends = LinkLine.first_round_id, LinkLine.second_round_id
    touching = or_(*(end.in_(round_ids) for end in ends))
    linked = select(*ends).where(LinkLine.kind == str(LinkKind.GROWTH), touching).distinct()
    for first, second in connection.execute(linked).all():
        if house_of[first] != house_of[second]:
            forget_links(connection, LinkKind.GROWTH, (first, second))


def _group_of(connection: Connection, detection: DetectionId) -> frozenset[str]:
    query = select(RoundLine.key).where(RoundLine.id == detection.round_id)
    links = links_of(connection, connection.execute(query).scalar_one())
    keys = {detection.key, *(end for link in links for end in (link.first, link.second))}
    return group_detections(keys, links)[detection.key]


def _action_to_undo(connection: Connection, number: int | None, round_key: str | None) -> Any:
    undone = select(Action.undoes_id).where(Action.undoes_id.is_not(None))
    query = select(Action.id, Action.kind, Action.round_id, Action.fruit, Action.details).where(
        Action.kind.not_in(NOT_UNDONE), Action.id.not_in(undone)
    )
    if number is not None:
        query = query.where(Action.id == number)
    if round_key is not None:
        query = query.where(Action.round_id == round_id_of(connection, round_key))
    action = connection.execute(query.order_by(Action.id.desc()).limit(1)).one_or_none()
    if action is None:
        what = "nothing to undo" if number is None else f"there is no action {number} to undo"
        raise StoreError(what, remedy="see the log")
    return action


def _blocked_by_later(number: int) -> StoreConflictError:
    return StoreConflictError(
        "a later action depends on action {number}",
        remedy="undo the later one first",
        number=number,
    )


def _log(
    connection: Connection,
    kind: str,
    fruit: Sequence[DetectionId],
    details: dict[str, Any] | None = None,
) -> int:
    return log_action(
        connection, kind, fruit[-1].round_id, [detection.key for detection in fruit], details
    )


def _mark(
    connection: Connection,
    action: int,
    fruit: Sequence[DetectionId],
    slot: str,
    value: str | None,
    details: dict[str, Any] | None = None,
) -> None:
    """End the value in a slot of each detection, and set a new one if it is given."""
    ids = sorted({detection.id for detection in fruit})
    _end(connection, Mark, action, (Mark.fruit_id.in_(ids)) & (Mark.slot == slot))
    if value is not None:
        cells = {"slot": slot, "value": str(value), "details": details or {}, "action_id": action}
        lines = [{"fruit_id": fruit_id, **cells} for fruit_id in ids]
        connection.execute(insert(Mark), lines)


def _end(
    connection: Connection, table: type[Mark] | type[LinkLine], action: int, which: Any
) -> None:
    change(connection, table, and_(table.ended_by_id.is_(None), which), ended_by_id=action)


_TABLES: dict[str, Any] = {"stops": StopLine, "rounds": RoundLine}


def line_of(connection: Connection, table: Any, key: str) -> Any:
    """Return all cells of a stop or round that was not deleted, and keep others from changing it.

    Raises
    ------
    StoreError
        If it is not there.
    """
    what = "stop" if table is StopLine else "round"
    query = select(*table.__table__.columns).where(table.key == checked_key(key, what))
    line = connection.execute(query.with_for_update(key_share=True)).one_or_none()
    if line is None or line.deleted:
        fault = what + " {key} is not in the store"  # a template of the catalogue
        raise StoreError(fault, remedy=f"see the list of {what}s", key=key)
    return line


def _place_cells(connection: Connection, round_id: int, place: StopPlace) -> dict[str, Any]:
    cells = asdict(place)
    row = cells.pop("row")
    return {**cells, "row_id": row if row is None else row_id_of(connection, round_id, row)}


def _edit(
    connection: Connection,
    table: Any,
    line: Any,
    kind: str,
    after: dict[str, Any],
    seen: dict[str, Any] | None = None,
) -> int:
    before = {name: getattr(line, name) for name in after}
    if seen is not None and before != seen:
        raise StoreConflictError(
            "somebody else has changed it meanwhile", remedy="look at it as it is now"
        )
    details = {"table": table.__tablename__, "key": line.key, "before": before, "after": after}
    round_id = line.id if table is RoundLine else line.round_id
    number = log_action(connection, kind, round_id, details=details)
    change_line(connection, details)
    return number


def log_action(
    connection: Connection,
    kind: str,
    round_id: int | None,
    fruit: Sequence[str] = (),
    details: dict[str, Any] | None = None,
    **cells: Any,
) -> int:
    """Add a line to the log, by who the store is signed by, and return its number."""
    signed = connection.get_execution_options()
    device = {"device": signed[DEVICE]} if signed.get(DEVICE) else {}
    line_cells = {
        "at_s": time.time(),
        "by": signed.get(SIGNED_BY, ""),
        "kind": kind,
        "fruit": list(fruit),
        "details": {**(details or {}), **device},
        "round_id": round_id,
        **cells,
    }
    line = insert(Action).values(**line_cells)
    return connection.execute(line.returning(Action.id)).scalar_one()


def change_line(connection: Connection, details: dict[str, Any], *, restore: bool = False) -> None:
    """Write an action's `details` into its stop or round, or with `restore` the values before it.

    Raises
    ------
    StoreConflictError
        If the line was changed since.
    """
    table = _TABLES[details["table"]]
    old, new = details["before"], details["after"]
    if restore:
        old, new = new, old
    unchanged = [getattr(table, name).is_not_distinct_from(value) for name, value in old.items()]
    # The fitted position of a stop that is moved is no longer valid: the next merge finds it again.
    fitted = {"fitted_m": None, "fitted_sd_m": None} if "position_m" in new else {}
    which = and_(table.key == details["key"], *unchanged)
    if change(connection, table, which, **new, **fitted) != 1:
        raise StoreConflictError("it was changed again since", remedy="undo the later change first")


def original_names(connection: Connection, round_key: str) -> dict[str, str]:
    """Return the name and house that a round had at first, of those that were changed."""
    changes = (
        select(Action.details)
        .join(RoundLine, RoundLine.id == Action.round_id)
        .where(RoundLine.key == round_key, Action.kind.in_(("rename-round", MOVE_ROUND)))
        .order_by(Action.id.desc())
    )
    names: dict[str, str] = {}
    for details in connection.execute(changes).scalars():
        names |= details["before"]
    return names
