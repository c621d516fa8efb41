"""The store: rounds, stops and detections in a database, their pictures beside it."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import and_, delete, func, or_, select

from cucumbervision.errors import StoreConflictError, StoreError
from cucumbervision.files import adapter
from cucumbervision.names import checked_name, same_house
from cucumbervision_greenhouse.store.cells import (
    cells_by_name,
    cells_of,
    change,
    columns_of,
    decoding,
    insert_all,
    insert_new,
    round_id_of,
    row_id_of,
)
from cucumbervision_greenhouse.store.corrections import (
    Corrections,
    find_detections,
    forget_links,
    lock_rounds,
    mark_added,
    original_names,
)
from cucumbervision_greenhouse.store.engine import database_url, make_engine, named, prepare
from cucumbervision_greenhouse.store.images import ImageStore
from cucumbervision_greenhouse.store.links import LinkKind
from cucumbervision_greenhouse.store.queries import Queries
from cucumbervision_greenhouse.store.records import (
    JointRecord,
    Round,
    Saved,
    StopRecord,
    checked_key,
    key_of,
    record_json,
)
from cucumbervision_greenhouse.store.schema import (
    ROUND_CELLS,
    CaptureLine,
    DetectionLine,
    JointLine,
    LinkLine,
    RoundLine,
    StopLine,
)
from cucumbervision_greenhouse.store.stop_content import add_content, add_detections, checked_stop

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from sqlalchemy import Connection

    from cucumbervision_greenhouse.store.links import LinkRecord, Position
    from cucumbervision_greenhouse.store.records import DetectionRecord

_LISTED_NAMES = ("key", "first", "views", "reason", "record")
_LISTED = columns_of(JointLine, _LISTED_NAMES)
_STOP_CELLS = ("key", "side", "position_m", "position_sd_m", "step", "taken_s", "note")


def open_store(where: str | Path, *, images: Path | None = None, create: bool = True) -> Store:
    """Open a store; a new one is made where there is none.

    Parameters
    ----------
    where : str or Path
        The path of an SQLite file, or 'postgresql://user@host/database?images=FOLDER'.
    images : Path, optional
        Folder of the pictures; by default that of the address. Beside an SQLite file 'house.db' it
        is 'house.images'; with PostgreSQL it must be named before pictures are read or written.
    create : bool
        False refuses an SQLite file that is not there: for reading alone.

    Raises
    ------
    StoreVersionError
        If another version of the software wrote it; nothing is changed then.
    StoreError
        If it cannot be opened, or is no store.
    MissingExtraError
        If PostgreSQL's driver is not installed.

    Examples
    --------
    >>> import tempfile
    >>> from cucumbervision.measurement.result import Length
    >>> from cucumbervision_greenhouse.store.records import CaptureRecord, DetectionRecord, Round
    >>> from cucumbervision_greenhouse.store.records import StopRecord, new_key
    >>> walk, stop = Round(name="morning"), new_key()
    >>> capture = CaptureRecord("a", fruit=(DetectionRecord(1, length=Length(0.31)),))
    >>> record = StopRecord(stop, walk.key, row="3", position_m=1.2, captures=(capture,))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with open_store(Path(folder) / "house.db") as store:
    ...         print(store.save_round(walk), store.save_stop(record), store.save_stop(record))
    ...         [fruit] = store.detections(walk.key)
    ...         print(fruit.row, fruit.along_m, fruit.record.length_m)
    new new already-there
    3 1.2 0.31
    """
    url = database_url(where)
    folder = url.query.get("images", "")
    url = url.difference_update_query(["images"])
    if isinstance(folder, tuple):
        raise StoreError(
            f"names {len(folder)} folders of pictures", source=named(url), remedy="name one"
        )
    if not create and url.get_backend_name() == "sqlite" and not Path(url.database or "").exists():
        raise StoreError("is not there", source=named(url), remedy="check the path")
    engine = make_engine(url)
    try:
        prepare(engine)
    except BaseException:
        engine.dispose()
        raise
    if images is None and folder:
        images = Path(folder)
    elif images is None and url.get_backend_name() == "sqlite":
        images = Path(url.database or "").with_suffix(".images")
    if images is not None:
        ImageStore(images).clean()
    return Store(engine, images)


class Store(Queries, Corrections):
    """An open store; `open_store` makes it. Any number of threads may use one.

    Each method is one transaction: what it writes is there whole or not at all, and on the disk
    when it returns. All raise `StoreError` where the database reports an error, or a key is not
    there.
    """

    def save_round(self, record: Round) -> Saved:
        """Add a round; the same one sent again changes nothing.

        Its house is the known one where their names differ by no more than case, spaces or the
        word 'house' (`names.same_house`).

        Raises
        ------
        StoreConflictError
            If another round has its key.
        NameRefusedError
            If one of its names is none.
        """
        record = replace(
            record,
            key=checked_key(record.key, "round"),
            name=checked_name(record.name, "round's name"),
            house=checked_name(record.house, "house"),
        )
        with self.writing() as connection:
            house_query = select(RoundLine.house).where(
                or_(~RoundLine.deleted, RoundLine.key == record.key)
            )
            houses = connection.execute(house_query.order_by(RoundLine.id)).scalars()
            sent_house = record.house
            record = replace(record, house=same_house(record.house, houses))
            cells = {**cells_by_name(record, ROUND_CELLS), "deleted": False}
            if insert_new(connection, RoundLine, cells, "key") is not None:
                return Saved.NEW
            columns = columns_of(RoundLine, ROUND_CELLS)
            values = connection.execute(select(*columns).where(RoundLine.key == record.key)).one()
            first = Round(*values)
            names = original_names(connection, record.key)
            house = names.get("house", first.house)
            first = replace(first, name=names.get("name", first.name), house=house)
            if first != replace(record, house=same_house(sent_house, [house])):
                raise _conflict("round", record.key)
            return Saved.ALREADY_THERE

    def save_stop(self, stop: StopRecord) -> Saved:
        """Add a stop with all that is in it; one sent again under its key changes nothing.

        Put its pictures into `images` first: a picture without a stop can be found and removed
        (`check_store`), a stop without its picture cannot be repaired.

        Raises
        ------
        NameRefusedError
            If its row, its side or a capture's name is none.
        StoreError
            If its round does not exist, a key is not a UUID, or two captures have the same name or
            two fruit of a capture the same number.
        """
        stop = checked_stop(stop)
        with self.writing() as connection:
            missing = "save the round first"
            round_id = round_id_of(connection, stop.round_key, remedy=missing)
            cells = {
                **cells_by_name(stop, _STOP_CELLS),
                "round_id": round_id,
                "row_id": None if stop.row is None else row_id_of(connection, round_id, stop.row),
                "pose": list(stop.pose),
                "failures": [dict(failure) for failure in stop.failures],
            }
            stop_id = insert_new(connection, StopLine, cells, "key")
            if stop_id is None:
                return Saved.ALREADY_THERE
            # The same keys on every machine: from the stop's, the capture's place, the number.
            keys = [
                [key_of("fruit", stop.key, number, fruit.number) for fruit in capture.fruit]
                for number, capture in enumerate(stop.captures)
            ]
            add_content(connection, stop_id, round_id, stop, keys)
        return Saved.NEW

    def add_fruit(self, stop_key: str, capture: str, record: DetectionRecord) -> str:
        """Add a fruit that was not found; logged. Return its key.

        It is accepted, unless it is flagged as doubtful.

        After `undo` it is left out of all lists, and its number is not used again.

        Parameters
        ----------
        stop_key, capture : str
            Where it was seen: the stop, and the capture's name in it.
        record : DetectionRecord
            As it was measured; it gets the capture's next number.

        Raises
        ------
        StoreError
            If the stop is not there, or has no such capture.
        """
        stop_key = checked_key(stop_key, "stop")
        capture_query = (
            select(CaptureLine.id, CaptureLine.number, StopLine.round_id)
            .join(StopLine, StopLine.id == CaptureLine.stop_id)
            .where(StopLine.key == stop_key, CaptureLine.name == capture, ~StopLine.deleted)
        )
        with self.writing() as connection:
            capture_cells = connection.execute(capture_query).one_or_none()
            if capture_cells is None:
                raise StoreError(
                    f"stop {stop_key} has no capture '{capture}'", remedy="look it up in stop()"
                )
            capture_id, place, round_id = capture_cells
            lock_rounds(connection, [round_id])
            highest = select(func.max(DetectionLine.number)).where(
                DetectionLine.capture_id == capture_id
            )
            number = (connection.execute(highest).scalar() or 0) + 1
            key = key_of("fruit", stop_key, place, number)
            numbered = replace(record, number=number)
            add_detections(connection, capture_id, round_id, [key], [numbered])
            mark_added(connection, key, accept="doubtful" not in record.flags.split())
        return key

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
            forget_links(connection, LinkKind.SAME, (round_id, round_id))
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
            forget_links(connection, LinkKind.GROWTH, rounds)
            return _add_links(connection, LinkKind.GROWTH, links, rounds)

    def save_joint(
        self, round_key: str, records: Sequence[JointRecord], keep: Collection[str]
    ) -> None:
        """Add joint measurements of a round; of the older ones only those of some keys stay."""
        with self.writing() as connection:
            round_id = round_id_of(connection, round_key)
            lock_rounds(connection, [round_id])
            key_query = select(JointLine.key).where(JointLine.round_id == round_id)
            stays = {*keep, *(joint.key for joint in records)}
            gone = [key for key in connection.execute(key_query).scalars() if key not in stays]
            for key in gone:
                connection.execute(delete(JointLine).where(JointLine.key == key))
            for joint in records:
                methods = (
                    [asdict(method) for method in joint.record.methods] if joint.record else []
                )
                drawing = {
                    "methods": methods,
                    "poses": {k: list(v) for k, v in joint.poses.items()},
                }
                cells = {
                    "key": joint.key,
                    "round_id": round_id,
                    "first": joint.first,
                    "views": joint.views,
                    "reason": joint.reason,
                    "record": joint.record and record_json(replace(joint.record, methods=())),
                    "drawing": drawing,
                }
                insert_new(connection, JointLine, cells, "key")

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


def _conflict(what: str, key: str) -> StoreConflictError:
    return StoreConflictError(
        f"{what} {key} is already stored with another content",
        remedy="give what differs a key of its own, from records.new_key()",
    )


def _joint_of(row: Sequence[Any], drawing: Mapping[str, Any] | None = None) -> JointRecord:
    """Return a joint measurement from its cells; with its drawing, which lists leave out."""
    values = dict(zip(_LISTED_NAMES, row, strict=True))
    if drawing is not None:
        values["poses"] = drawing["poses"]
        if values["record"] is not None:
            values["record"] = {**values["record"], "methods": drawing["methods"]}
    joint: JointRecord = adapter(JointRecord).validate_python(values)
    return joint


def _add_links(
    connection: Connection, kind: LinkKind, links: Sequence[LinkRecord], rounds: tuple[int, int]
) -> int:
    if not links:
        return 0
    keys = sorted({key for link in links for key in (link.first, link.second)})
    ids = dict(zip(keys, find_detections(connection, keys), strict=True))
    decided = _decided_pairs(connection, rounds)
    lines = {}
    for link in links:
        first, second = ids[link.first], ids[link.second]
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
            lines[pair] = cells
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
