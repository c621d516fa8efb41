"""What people decide about fruit, stops and rounds: each a mark with author and time.

The marks of a fruit are read in order, and the last one of its kind counts; undo takes a mark back
by another one. Marks of a stop or a round change its line, which every list reads, and hold the
values before. What is deleted stays in the tables, out of all lists.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, Table, and_, delete, insert, or_, select, update

from cucumbervision.capture.frames import Stop
from cucumbervision.errors import StoreConflictError, StoreError
from cucumbervision.names import checked_name, same_house
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.engine import DEVICE, SIGNED_BY, Database
from cucumbervision_greenhouse.store.schema import CAPTURES, FRUIT, LINKS, MARKS, ROUNDS, STOPS

LARGEST_STEP = 2**31 - 1  # of a column of whole numbers in PostgreSQL

TAKE_BACK = "take-back-stop"
"""The kind of mark that deletes a stop because its press was taken back."""
MOVE_ROUND = "move-round"
"""The kind of mark that puts a round into another house."""
STOP_EDITS = ("place-stop", "delete-stop", TAKE_BACK)
"""Kinds of mark after which a round's views must be merged again."""
NOT_UNDONE = ("undo", "measure-again")
"""Kinds that cannot be undone; before 0.2 stops were measured again in place."""

_VERDICTS = {"accept": records.Verdict.ACCEPTED, "reject": records.Verdict.REJECTED, "clear": None}
_LINK_KINDS = {
    "merge": records.LinkKind.SAME,
    "unmerge": records.LinkKind.APART,
    "link-growth": records.LinkKind.GROWTH,
    "unlink-growth": records.LinkKind.APART,
}
"""Marks of links by hand; those within a round were made by the dashboard of 0.1.0."""
_PLACE = ("row", "side", "position_m", "step", "note", "mirrored")


def is_active(fruit: Any = FRUIT.c) -> Any:
    """Return whether a fruit counts, for a query: it and its stop are not deleted."""
    gone = select(CAPTURES.c.id).join(STOPS, STOPS.c.id == CAPTURES.c.stop_id)
    return and_(~fruit.deleted, fruit.capture_id.not_in(gone.where(STOPS.c.deleted)))


IS_ACTIVE = is_active()


class Marks(Database):
    """Marks on fruit, stops and rounds. Each method returns the mark's number in the log.

    The author is who the store is signed by (`Database.signed`). All raise `StoreError` where a
    fruit, stop or round does not exist. With `seen`, what the caller saw before, they raise
    `StoreConflictError` where somebody else has changed it since.
    """

    def set_verdict(self, fruit: Sequence[str], verdict: records.Verdict | None) -> int:
        """Accept or reject fruit; None removes the verdict."""
        kind = next(kind for kind, value in _VERDICTS.items() if value is verdict)
        return self._mark(kind, fruit)

    def pick(self, fruit: Sequence[str], *, at_s: float | None = None) -> int:
        """Record that fruit were picked at a time, by default now."""
        return self._mark("pick", fruit, {"at_s": time.time() if at_s is None else at_s})

    def unpick(self, fruit: Sequence[str]) -> int:
        """Record that fruit were not picked."""
        return self._mark("unpick", fruit)

    def correct(self, key: str, row: records.FruitRow) -> int:
        """Replace a fruit's row by one with a corrected outline; the first one is kept."""
        return self._mark("correct", [key], {"row": {**row.cells, **row.shape}})

    def _mark(self, kind: str, keys: Sequence[str], details: dict[str, Any] | None = None) -> int:
        with self.writing() as connection:
            fruit = find_fruit(connection, list(dict.fromkeys(keys)))
            return write_mark(
                connection, kind, fruit[-1].round_id, [line.key for line in fruit], details
            )

    def keep_harvest(self, round_key: str, lines: Sequence[dict[str, Any]]) -> int:
        """Record a harvest of a round's house, as `rounds.harvest` reads it."""
        with self.writing() as connection:
            round_id = round_id_of(connection, round_key)
            return write_mark(connection, "harvest", round_id, details={"lines": list(lines)})

    def decide_growth(self, first: str, last: str, *, same: bool) -> int:
        """Record whether a fruit of one day is that of a later one."""
        with self.writing() as connection:
            fruit = find_fruit(connection, [first, last])
            kind = "link-growth" if same else "unlink-growth"
            details = {"rounds": [x.round_id for x in fruit], "ends": [[first, last]]}
            return write_mark(connection, kind, fruit[-1].round_id, [first, last], details)

    def place_stop(self, stop: records.StopRecord, seen: records.StopRecord | None = None) -> int:
        """Set where a stop was taken, and its name; its fitted position is discarded.

        Raises
        ------
        NameRefusedError
            If its row, side or name is none.
        """
        check_place(stop)
        after, before = (
            None if place is None else {name: getattr(place, name) for name in _PLACE}
            for place in (stop, seen)
        )
        with self.writing() as connection:
            return _edit(connection, STOPS, stop.key, "place-stop", after or {}, before)

    def delete_stop(self, key: str, *, taken_back: bool = False) -> int:
        """Take a stop with all its fruit out of every list.

        `taken_back` logs that its press was taken back, which is no new thing to be undone before
        what was done earlier.
        """
        kind = TAKE_BACK if taken_back else "delete-stop"
        with self.writing() as connection:
            return _edit(connection, STOPS, key, kind, {"deleted": True})

    def rename_round(self, key: str, name: str, seen: str | None = None) -> int:
        """Rename a round.

        Raises
        ------
        NameRefusedError
            If that is no name.
        """
        name = checked_name(name, "round's name")
        before = None if seen is None else {"name": seen}
        with self.writing() as connection:
            return _edit(connection, ROUNDS, key, "rename-round", {"name": name}, before)

    def move_rounds(self, keys: Sequence[str], house: str, seen: str | None = None) -> int:
        """Move rounds to a house: all of one house to rename it, or to merge it with another.

        The house is the known one where the names differ by no more than case, spaces or the word
        'house', unless only the spelling changes. Their computed links of growth are removed.

        Returns
        -------
        int
            How many rounds were moved; one mark each.

        Raises
        ------
        NameRefusedError
            If that is no name.
        """
        house = checked_name(house, "house")
        before = None if seen is None else {"house": seen}
        with self.writing() as connection:
            lines = [line_of(connection, ROUNDS, key) for key in keys]
            houses = select(ROUNDS.c.house).where(~ROUNDS.c.deleted, ROUNDS.c.key.not_in(keys))
            house = same_house(house, connection.execute(houses.order_by(ROUNDS.c.id)).scalars())
            moved = [line for line in lines if line.house != house]
            for line in moved:
                _edit(connection, ROUNDS, line.key, MOVE_ROUND, {"house": house}, before)
            _forget_growth(connection, [line.id for line in moved])
        return len(moved)

    def delete_round(self, key: str) -> int:
        """Take a round with all its stops out of the list of rounds."""
        with self.writing() as connection:
            return _edit(connection, ROUNDS, key, "delete-round", {"deleted": True})

    def undo(self, round_key: str | None = None, *, number: int | None = None) -> int:
        """Take back a mark: the round's newest that was not taken back, or the one named.

        Raises
        ------
        StoreConflictError
            If a later change depends on it.
        StoreError
            If there is nothing to undo.
        """
        query = select(MARKS).where(MARKS.c.kind.not_in(NOT_UNDONE), _not_undone())
        with self.writing() as connection:
            if number is not None:
                query = query.where(MARKS.c.id == number)
            if round_key is not None:
                query = query.where(MARKS.c.round_id == round_id_of(connection, round_key))
            mark = connection.execute(query.order_by(MARKS.c.id.desc()).limit(1)).one_or_none()
            if mark is None:
                what = "nothing to undo" if number is None else "there is no mark {number} to undo"
                raise StoreError(what, remedy="see the log", number=number)
            details = {"kind": mark.kind}
            made = write_mark(
                connection, "undo", mark.round_id, mark.fruit, details, undoes_id=mark.id
            )
            if "before" in mark.details:
                _change_line(connection, mark.details, restore=True)
            if mark.kind == MOVE_ROUND:
                _forget_growth(connection, [mark.round_id])
        return made


def _not_undone() -> Any:
    undoing = MARKS.alias()
    taken_back = select(undoing.c.undoes_id).where(undoing.c.undoes_id.is_not(None))
    return and_(MARKS.c.id.not_in(taken_back), MARKS.c.undoes_id.is_(None))


def check_place(stop: records.StopRecord) -> None:
    """Check the place, name and number of a stop: every database takes them alike.

    Raises
    ------
    NameRefusedError
        If a name cannot be read.
    CaptureError
        If the position is farther than any row is long.
    StoreError
        If the number is too large.
    """
    Stop(stop.row, stop.side, stop.position_m)
    checked_name(stop.note, "stop's name")
    if abs(stop.step or 0) > LARGEST_STEP:
        raise StoreError(
            "a stop has no number {number}",
            remedy=f"at most {LARGEST_STEP} are taken",
            number=stop.step,
        )


def find_fruit(connection: Connection, keys: Sequence[str]) -> list[Any]:
    """Find fruit by their keys, in that order (key, id, round_id).

    Raises
    ------
    StoreError
        If one is not there, or none was named.
    """
    if not keys:
        raise StoreError("no fruit was named", remedy="name at least one")
    query = select(FRUIT.c.key, FRUIT.c.id, FRUIT.c.round_id)
    query = query.where(FRUIT.c.key.in_(keys), IS_ACTIVE)
    fruit = {line.key: line for line in connection.execute(query)}
    missing = next((key for key in keys if key not in fruit), None)
    if missing is not None:
        raise StoreError(
            "fruit {key} is not in the store", remedy="look it up in detections()", key=missing
        )
    return [fruit[key] for key in keys]


def round_id_of(connection: Connection, key: str, *, remedy: str = "see `round list`") -> int:
    """Return a round's number in the tables, deleted or not.

    Raises
    ------
    StoreError
        If it is not there, with this remedy.
    """
    query = select(ROUNDS.c.id).where(ROUNDS.c.key == key)
    round_id = connection.execute(query).scalar()
    if round_id is None:
        raise StoreError("round {key} is not in the store", remedy=remedy, key=key)
    return int(round_id)


def write_mark(
    connection: Connection,
    kind: str,
    round_id: int | None,
    fruit: Sequence[str] = (),
    details: dict[str, Any] | None = None,
    undoes_id: int | None = None,
) -> int:
    """Add a mark by who the store is signed by, and return its number."""
    signed = connection.get_execution_options()
    device = {"device": signed[DEVICE]} if signed.get(DEVICE) else {}
    cells = {
        "at_s": time.time(),
        "by": signed.get(SIGNED_BY, ""),
        "kind": kind,
        "fruit": list(fruit),
        "details": {**(details or {}), **device},
        "round_id": round_id,
        "undoes_id": undoes_id,
    }
    mark = insert(MARKS).values(**cells).returning(MARKS.c.id)
    return int(connection.execute(mark).scalar_one())


def marks_of(connection: Connection, round_id: int) -> dict[str, dict[str, Any]]:
    """Return what people decided about a round's fruit, by the fruit's keys.

    Each 'verdict', 'picked_s' and 'row' (the corrected one), as far as there is one.
    """
    query = select(MARKS.c.kind, MARKS.c.fruit, MARKS.c.details)
    query = query.where(MARKS.c.round_id == round_id, _not_undone()).order_by(MARKS.c.id)
    marks: dict[str, dict[str, Any]] = {}
    for kind, fruit, details in connection.execute(query):
        decided: dict[str, Any] = {}
        if kind in _VERDICTS or "verdict" in details:
            decided["verdict"] = _VERDICTS[details.get("verdict", kind)]
        elif kind in ("pick", "unpick"):
            decided["picked_s"] = details.get("at_s")
        elif kind == "correct":
            decided["row"] = details["row"]
        for key in fruit if decided else ():
            marks.setdefault(key, {}).update(decided)
    return marks


def links_of(
    connection: Connection, round_id: int, kind: records.LinkKind | None = None
) -> list[records.LinkRecord]:
    """Return the links that touch a round, those by hand in place of others of the same pair."""
    first, second = FRUIT.alias(), FRUIT.alias()
    query = (
        select(LINKS.c.kind, first.c.key, second.c.key, LINKS.c.score)
        .join(first, first.c.id == LINKS.c.first_id)
        .join(second, second.c.id == LINKS.c.second_id)
        .where(
            or_(LINKS.c.first_round_id == round_id, LINKS.c.second_round_id == round_id),
            is_active(first.c),
            is_active(second.c),
        )
        .order_by(LINKS.c.id)
    )
    links = {
        frozenset((a, b)): records.LinkRecord(records.LinkKind(name), a, b, score)
        for name, a, b, score in connection.execute(query)
    }
    links |= _links_by_hand(connection, round_id)
    return [link for link in links.values() if kind in (None, link.kind)]


def _links_by_hand(
    connection: Connection, round_id: int
) -> dict[frozenset[str], records.LinkRecord]:
    """Return the links that people made in a round, or between it and another, by their pairs."""
    query = select(MARKS.c.kind, MARKS.c.fruit, MARKS.c.details)
    query = query.where(MARKS.c.kind.in_(_LINK_KINDS), _not_undone()).order_by(MARKS.c.id)
    links: dict[frozenset[str], records.LinkRecord] = {}
    for kind, (first, *others), details in connection.execute(query):
        if round_id in details["rounds"]:
            for pair in details.get("ends", ()):
                links.pop(frozenset(pair), None)
            for key in others:
                link = records.LinkRecord(_LINK_KINDS[kind], first, key, by_hand=True)
                links[frozenset((first, key))] = link
    keys = {key for pair in links for key in pair}
    there = set(
        connection.execute(select(FRUIT.c.key).where(FRUIT.c.key.in_(keys), IS_ACTIVE)).scalars()
    )
    return {pair: link for pair, link in links.items() if pair <= there}


def forget_links(connection: Connection, kind: records.LinkKind, rounds: tuple[int, int]) -> None:
    """Remove the links that an algorithm made between two rounds, or within one."""
    connection.execute(
        delete(LINKS).where(
            LINKS.c.kind == str(kind),
            LINKS.c.first_round_id == rounds[0],
            LINKS.c.second_round_id == rounds[1],
        )
    )


def _forget_growth(connection: Connection, round_ids: Sequence[int]) -> None:
    """Remove computed links of growth of rounds that change house: they are linked again there."""
    ends = LINKS.c.first_round_id, LINKS.c.second_round_id
    of_rounds = or_(*(end.in_(round_ids) for end in ends))
    connection.execute(delete(LINKS).where(LINKS.c.kind == str(records.LinkKind.GROWTH), of_rounds))


def line_of(connection: Connection, table: Table, key: str) -> Any:
    """Return all cells of a stop or round that was not deleted.

    Raises
    ------
    StoreError
        If it is not there.
    """
    what = "stop" if table is STOPS else "round"
    line = connection.execute(select(table).where(table.c.key == key)).one_or_none()
    if line is None or line.deleted:
        raise StoreError(
            f"{what} {{key}} is not in the store", remedy=f"see the list of {what}s", key=key
        )
    return line


def _edit(
    connection: Connection,
    table: Table,
    key: str,
    kind: str,
    after: dict[str, Any],
    seen: dict[str, Any] | None = None,
) -> int:
    line = line_of(connection, table, key)
    before = {name: getattr(line, name) for name in after}
    if seen is not None and before != seen:
        raise StoreConflictError(
            "somebody else has changed it meanwhile", remedy="look at it as it is now"
        )
    details = {"table": table.name, "key": line.key, "before": before, "after": after}
    number = write_mark(
        connection, kind, line.id if table is ROUNDS else line.round_id, details=details
    )
    _change_line(connection, details)
    return number


def _change_line(connection: Connection, details: dict[str, Any], *, restore: bool = False) -> None:
    """Write a mark's `details` into its line, or with `restore` the values before it.

    Raises
    ------
    StoreConflictError
        If the line was changed since.
    """
    table = {"stops": STOPS, "rounds": ROUNDS, "fruit": FRUIT}[details["table"]]
    old, new = details["before"], details["after"]
    if restore:
        old, new = new, old
    unchanged = [table.c[name].is_not_distinct_from(value) for name, value in old.items()]
    # The fitted position of a stop that is moved is no longer valid: the next merge finds it again.
    fitted = {"fitted_m": None, "fitted_sd_m": None} if "position_m" in new else {}
    line = update(table).where(table.c.key == details["key"], *unchanged)
    if connection.execute(line.values(**new, **fitted)).rowcount != 1:
        raise StoreConflictError("it was changed again since", remedy="undo the later change first")
