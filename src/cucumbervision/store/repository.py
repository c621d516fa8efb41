"""The store: rounds, stops and detections in a database, their pictures beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import and_, func, insert, or_, select, update

from cucumbervision.errors import StoreConflictError, StoreError
from cucumbervision.store.cells import (
    columns_of,
    detection_cells,
    id_of,
    insert_all,
    insert_new,
    pack_um,
    round_id_of,
    row_id_of,
)
from cucumbervision.store.check import change, seal_stops, with_hash
from cucumbervision.store.corrections import (
    MEASURE_AGAIN,
    Corrections,
    lock_rounds,
    log_action,
    mark_added,
    original_name,
    stop_line,
)
from cucumbervision.store.engine import database_url, make_engine, named, prepare
from cucumbervision.store.images import ImageStore
from cucumbervision.store.merging import Merging
from cucumbervision.store.queries import Queries
from cucumbervision.store.records import (
    RoundRecord,
    Saved,
    StopRecord,
    checked_key,
    content_sha256,
    key_of,
    new_key,
    record_json,
)
from cucumbervision.store.schema import (
    CAPTURE_CELLS,
    METHOD_CELLS,
    ROUND_CELLS,
    Artifact,
    CaptureLine,
    DetectionLine,
    Image,
    LinkLine,
    Mark,
    MaskLine,
    MethodLine,
    Round,
    StopArtifact,
    StopLine,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sqlalchemy import Connection

    from cucumbervision.store.records import ArtifactRecord, CaptureRecord, DetectionRecord

_STOP_CELLS = ("key", "side", "position_m", "position_sd_m", "step", "taken_s", "note")


def open_store(where: str | Path, *, images: Path | None = None, create: bool = True) -> Store:
    """Open a store; a new one is made where there is none.

    Parameters
    ----------
    where : str or Path
        The path of an SQLite file, or 'postgresql://user@host/database'.
    images : Path, optional
        Folder of the pictures. Beside an SQLite file 'house.db' it is 'house.images'; with
        PostgreSQL it must be named before pictures are read or written.
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
    >>> from cucumbervision.store.records import CaptureRecord, DetectionRecord, RoundRecord
    >>> from cucumbervision.store.records import StopRecord, new_key
    >>> walk, stop = RoundRecord(name="morning"), new_key()
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
    if not create and url.get_backend_name() == "sqlite" and not Path(url.database or "").exists():
        raise StoreError("is not there", source=named(url), remedy="check the path")
    engine = make_engine(url)
    try:
        prepare(engine)
    except BaseException:
        engine.dispose()
        raise
    if images is None and url.get_backend_name() == "sqlite":
        images = Path(url.database or "").with_suffix(".images")
    if images is not None:
        ImageStore(images).clean()
    return Store(engine, images)


class Store(Queries, Corrections, Merging):
    """An open store; `open_store` makes it. Any number of threads may use one.

    Each method is one transaction: what it writes is there whole or not at all, and on the disk
    when it returns. All raise `StoreError` where the database reports an error, or a key is not
    there.
    """

    def save_round(self, record: RoundRecord) -> Saved:
        """Add a round; the same one sent again changes nothing.

        Raises
        ------
        StoreConflictError
            If another round has its key.
        """
        record = replace(record, key=checked_key(record.key, "round"))
        with self.writing() as connection:
            cells = with_hash(Round, {**_cells(record, ROUND_CELLS), "deleted": False})
            if insert_new(connection, Round, cells, "key") is not None:
                return Saved.NEW
            columns = columns_of(Round, ROUND_CELLS)
            found = connection.execute(select(*columns).where(Round.key == record.key)).one()
            first = RoundRecord(*found)
            if (name := original_name(connection, record.key)) is not None:
                first = replace(first, name=name)
            if first != record:
                raise _conflict("round", record.key)
            return Saved.ALREADY_THERE

    def save_stop(self, stop: StopRecord) -> Saved:
        """Add a stop with all that is in it; the same one sent again changes nothing.

        Put its pictures into `images` first: a picture without a stop can be found and removed
        (`check_store`), a stop without its picture cannot be repaired.

        Raises
        ------
        StoreConflictError
            If another stop has its key.
        StoreError
            If its round is not there, a key is no UUID, two captures have one name or two fruit of
            a capture one number.
        """
        stop = _checked_stop(stop)
        sha256 = content_sha256(stop)
        with self.writing() as connection:
            round_id = round_id_of(connection, stop.round_key)
            cells = {
                **_cells(stop, _STOP_CELLS),
                "content_sha256": sha256,
                "round_id": round_id,
                "row_id": None if stop.row is None else row_id_of(connection, round_id, stop.row),
                "pose": list(stop.pose),
                "failures": [dict(failure) for failure in stop.failures],
            }
            stop_id = insert_new(connection, StopLine, with_hash(StopLine, cells), "key")
            if stop_id is None:
                stored = select(StopLine.content_sha256).where(StopLine.key == stop.key)
                if connection.execute(stored).scalar_one() != sha256:
                    raise _conflict("stop", stop.key)
                return Saved.ALREADY_THERE
            # The same keys on every machine: from the stop's, the capture's place, the number.
            keys = [
                [key_of("fruit", stop.key, number, one.number) for one in capture.fruit]
                for number, capture in enumerate(stop.captures)
            ]
            _add_content(connection, stop_id, round_id, stop, keys)
            seal_stops(connection, StopLine.id == stop_id)
        return Saved.NEW

    def measure_again(
        self,
        stop: StopRecord,
        same: Mapping[str, tuple[str, int]],
        corrected: Mapping[str, DetectionRecord],
        *,
        by: str = "",
    ) -> int:
        """Replace what was measured at a stop; logged, and not to be undone.

        The stop stays where it is. A fruit that is the same as before keeps its key and all that
        was said of it by hand. What was measured before stays in the tables, in no list.

        Parameters
        ----------
        stop : StopRecord
            As measured now, under the key that it has.
        same : mapping of str to (str, int)
            Capture and number that a fruit has now, by its key.
        corrected : mapping of str to DetectionRecord
            As measured now with its corrected mask, by its key.
        by : str
            Who had it measured.

        Raises
        ------
        StoreError
            If the stop is not there.
        """
        stop = _checked_stop(stop)
        sha256 = content_sha256(stop)
        known = {now: key for key, now in same.items()}
        with self.writing() as connection:
            line = stop_line(connection, stop.key)
            lock_rounds(connection, [line.round_id])
            aside, old = _put_aside(connection, line)
            keys = [
                [
                    known.get((capture.name, one.number))
                    or key_of("fruit", stop.key, sha256, number, one.number)
                    for one in capture.fruit
                ]
                for number, capture in enumerate(stop.captures)
            ]
            _add_content(connection, line.id, line.round_id, stop, keys)
            _carry_over(connection, old, corrected)
            cells = {"content_sha256": sha256, "failures": [dict(one) for one in stop.failures]}
            connection.execute(update(StopLine).where(StopLine.id == line.id).values(**cells))
            seal_stops(connection, StopLine.id.in_((aside, line.id)))
            gone = sorted(old.keys() - same.keys())
            details = {"key": stop.key, "gone": gone}
            return log_action(connection, MEASURE_AGAIN, by, line.round_id, list(same), details)

    def add_fruit(
        self, stop_key: str, capture: str, record: DetectionRecord, *, by: str = ""
    ) -> str:
        """Add a fruit that was not found; logged. Return its key.

        It is accepted, unless it is flagged as doubtful.

        Taken back by `undo`, it is in no list any more, and its number is not given again.

        Parameters
        ----------
        stop_key, capture : str
            Where it was seen: the stop, and the capture's name in it.
        record : DetectionRecord
            As it was measured; it gets the capture's next number.
        by : str
            Who added it.

        Raises
        ------
        StoreError
            If the stop is not there, or has no such capture.
        """
        stop_key = checked_key(stop_key, "stop")
        at = (
            select(CaptureLine.id, CaptureLine.number, StopLine.round_id)
            .join(StopLine, StopLine.id == CaptureLine.stop_id)
            .where(StopLine.key == stop_key, CaptureLine.name == capture, ~StopLine.deleted)
        )
        with self.writing() as connection:
            found = connection.execute(at).one_or_none()
            if found is None:
                raise StoreError(
                    f"stop {stop_key} has no capture '{capture}'", remedy="look it up in stop()"
                )
            capture_id, place, round_id = found
            lock_rounds(connection, [round_id])
            highest = select(func.max(DetectionLine.number)).where(
                DetectionLine.capture_id == capture_id
            )
            number = (connection.execute(highest).scalar() or 0) + 1
            key = key_of("fruit", stop_key, place, number)
            numbered = replace(record, number=number)
            _add_detections(connection, capture_id, round_id, [key], [numbered])
            seal_stops(connection, StopLine.key == stop_key)
            mark_added(connection, key, by, accept="doubtful" not in record.flags.split())
        return key


def _checked_stop(stop: StopRecord) -> StopRecord:
    """Return a stop with its keys in canonical form."""
    stop = replace(
        stop,
        key=checked_key(stop.key, "stop"),
        round_key=checked_key(stop.round_key, "round"),
    )
    _check_once([capture.name for capture in stop.captures], stop.key, "captures are called")
    for capture in stop.captures:
        _check_once([fruit.number for fruit in capture.fruit], capture.name, "fruit have number")
    return stop


def _check_once(names: Sequence[object], source: str, what: str) -> None:
    double = next((name for name in names if names.count(name) > 1), None)
    if double is not None:
        raise StoreError(f"two {what} {double}", source=source, remedy="give each its own")


def _cells(record: Any, names: Sequence[str]) -> dict[str, Any]:
    return {name: getattr(record, name) for name in names}


def _add_content(
    connection: Connection,
    stop_id: int,
    round_id: int,
    stop: StopRecord,
    keys: Sequence[Sequence[str]],
) -> None:
    """Add a stop's artifacts, captures and fruit; the fruit's keys by capture."""
    _add_artifacts(connection, stop_id, stop.artifacts)
    _add_images(connection, stop.captures)
    for number, (capture, own) in enumerate(zip(stop.captures, keys, strict=True)):
        capture_id = _add_capture(connection, stop_id, number, capture)
        _add_detections(connection, capture_id, round_id, own, capture.fruit)


def _add_artifacts(
    connection: Connection, stop_id: int, artifacts: Sequence[ArtifactRecord]
) -> None:
    unique = ("kind", "name", "sha256")
    # In one order for all, so that two writers never wait for each other in a circle.
    ids = {
        number: id_of(connection, Artifact, record_json(artifacts[number]), *unique)
        for number in sorted(
            range(len(artifacts)), key=lambda n: [getattr(artifacts[n], one) for one in unique]
        )
    }
    lines = [
        {"stop_id": stop_id, "number": number, "artifact_id": ids[number]} for number in sorted(ids)
    ]
    insert_all(connection, StopArtifact, lines)


def _add_images(connection: Connection, captures: Sequence[CaptureRecord]) -> None:
    refs = (ref for one in captures for ref in (one.color, one.depth, one.thumbnail))
    images = {ref.sha256: ref for ref in refs if ref is not None}
    for sha256 in sorted(images):
        insert_new(connection, Image, vars(images[sha256]), "sha256")


def _add_capture(connection: Connection, stop_id: int, number: int, capture: CaptureRecord) -> int:
    refs = {"color": capture.color, "depth": capture.depth, "thumbnail": capture.thumbnail}
    cells = {
        **_cells(capture, CAPTURE_CELLS),
        "camera": dict(capture.camera),
        "provenance": dict(capture.provenance),
        **{f"{name}_sha256": ref and ref.sha256 for name, ref in refs.items()},
        "stop_id": stop_id,
        "number": number,
    }
    line = insert(CaptureLine).values(**cells).returning(CaptureLine.id)
    return connection.execute(line).scalar_one()


def _add_detections(
    connection: Connection,
    capture_id: int,
    round_id: int,
    keys: Sequence[str],
    records: Sequence[DetectionRecord],
) -> None:
    if not records:
        return
    lines = [
        {
            **detection_cells(record),
            "key": key,
            "capture_id": capture_id,
            "round_id": round_id,
        }
        for key, record in zip(keys, records, strict=True)
    ]
    add = insert(DetectionLine).returning(DetectionLine.id, sort_by_parameter_order=True)
    ids = connection.execute(add, lines).scalars().all()
    masks = [
        {"fruit_id": i, "rle": record.mask, "keypoints": [list(p) for p in record.keypoints]}
        for i, record in zip(ids, records, strict=True)
    ]
    insert_all(connection, MaskLine, masks)
    methods = [
        {
            **_cells(method, METHOD_CELLS),
            "fruit_id": i,
            "number": number,
            "path_um": pack_um(method.path_m),
            "diameter_um": pack_um(method.diameter_m),
        }
        for i, record in zip(ids, records, strict=True)
        for number, method in enumerate(record.methods)
    ]
    insert_all(connection, MethodLine, methods)


def _conflict(what: str, key: str) -> StoreConflictError:
    return StoreConflictError(
        f"{what} {key} is already stored with another content",
        remedy="give what differs a key of its own, from records.new_key()",
    )


def _put_aside(connection: Connection, line: Any) -> tuple[int, dict[str, int]]:
    """Move a stop's captures to a deleted stop.

    Return that stop's number, and the fruit's numbers by their old keys.

    Parameters
    ----------
    connection : Connection
        In a transaction.
    line : Row
        The stop's line, all columns.
    """
    cells = {**line._mapping, "key": new_key(), "deleted": True}
    del cells["id"]
    copied = insert(StopLine).values(**with_hash(StopLine, cells)).returning(StopLine.id)
    aside = connection.execute(copied).scalar_one()
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
    return aside, {one.key: one.id for one in old}


def _carry_over(
    connection: Connection, old: Mapping[str, int], corrected: Mapping[str, DetectionRecord]
) -> None:
    """Give what people and algorithms said of fruit to those that have their keys now.

    Parameters
    ----------
    connection : Connection
        In the same transaction.
    old : mapping of str to int
        Of `_put_aside`.
    corrected : mapping of str to DetectionRecord
        Fruit of which a person corrected the mask, as measured again with it.
    """
    found = select(DetectionLine.key, DetectionLine.id).where(DetectionLine.key.in_(old))
    for key, new in connection.execute(found).all():
        was = old[key]
        # A correction that was itself replaced stays with what it was measured from.
        current = or_(Mark.slot != "mask", Mark.ended_by_id.is_(None))
        change(connection, Mark, and_(Mark.fruit_id == was, current), fruit_id=new)
        for end in ("first_id", "second_id"):
            change(connection, LinkLine, getattr(LinkLine, end) == was, **{end: new})
        active = and_(Mark.fruit_id == new, Mark.slot == "mask", Mark.ended_by_id.is_(None))
        if key in corrected:
            details = record_json(corrected[key])
            change(connection, Mark, active, value="corrected", details=details)
