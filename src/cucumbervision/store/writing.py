"""Write a round and its stops: each in one transaction, each once."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from sqlalchemy import insert, select
from sqlalchemy.dialects import postgresql, sqlite

from cucumbervision.errors import StoreConflictError, StoreError
from cucumbervision.store.lines import (
    CAPTURE_CELLS,
    FRUIT_CELLS,
    METHOD_CELLS,
    pack_um,
    simple_cells,
)
from cucumbervision.store.records import (
    RoundRecord,
    StopRecord,
    checked_key,
    content_sha256,
    key_of,
    record_json,
)
from cucumbervision.store.schema import (
    Artifact,
    Base,
    CaptureLine,
    FruitLine,
    Image,
    MaskLine,
    MethodLine,
    Round,
    Row,
    StopArtifact,
    StopLine,
)
from cucumbervision.store.views import Saved

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sqlalchemy import Connection

    from cucumbervision.store.records import (
        ArtifactRecord,
        CaptureRecord,
        FruitRecord,
        ImageRef,
    )

__all__ = ["checked_stop", "fruit_key", "round_id_of", "save_round", "save_stop"]

_ROUND_CELLS = ("key", "name", "house", "started_s", "profile", "note")
_STOP_CELLS = ("key", "side", "position_m", "position_sd_m", "step", "taken_s", "note")


def fruit_key(stop_key: str, capture_number: int, fruit_number: int) -> str:
    """Give the key that a fruit of a stop has, on every machine.

    Parameters
    ----------
    stop_key : str
        Its stop's.
    capture_number : int
        The capture's place in the stop, from 0.
    fruit_number : int
        The fruit's number in the capture, from 1.
    """
    return key_of("fruit", stop_key, capture_number, fruit_number)


def checked_stop(stop: StopRecord) -> StopRecord:
    """Give a stop with its keys in their usual writing.

    Raises
    ------
    StoreError
        If a key is no UUID, two captures have one name or two fruit of a capture one number.
    """
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


def save_round(connection: Connection, record: RoundRecord) -> Saved:
    """Add a round.

    Raises
    ------
    StoreConflictError
        If another round has its key.
    """
    record = replace(record, key=checked_key(record.key, "round"))
    if _insert_new(connection, Round, simple_cells(record, _ROUND_CELLS), "key") is not None:
        return Saved.NEW
    columns = [getattr(Round, name) for name in _ROUND_CELLS]
    found = connection.execute(select(*columns).where(Round.key == record.key)).one()
    if RoundRecord(*found) != record:
        raise _conflict("round", record.key)
    return Saved.ALREADY_THERE


def save_stop(connection: Connection, stop: StopRecord) -> Saved:
    """Add a stop that `checked_stop` checked, with everything in it.

    Raises
    ------
    StoreConflictError
        If another stop has its key.
    StoreError
        If its round is not there.
    """
    sha256 = content_sha256(stop)
    round_id, house = _round_of(connection, stop.round_key)
    cells = {
        **simple_cells(stop, _STOP_CELLS),
        "content_sha256": sha256,
        "round_id": round_id,
        "row_id": None if stop.row is None else _row_id(connection, house, stop.row),
        "pose": list(stop.pose),
        "failures": [dict(failure) for failure in stop.failures],
    }
    stop_id = _insert_new(connection, StopLine, cells, "key")
    if stop_id is None:
        stored = select(StopLine.content_sha256).where(StopLine.key == stop.key)
        if connection.execute(stored).scalar_one() != sha256:
            raise _conflict("stop", stop.key)
        return Saved.ALREADY_THERE
    _add_artifacts(connection, stop_id, stop.artifacts)
    _add_images(connection, stop.captures)
    for number, capture in enumerate(stop.captures):
        capture_id = _add_capture(connection, stop_id, number, capture)
        keys = [fruit_key(stop.key, number, fruit.number) for fruit in capture.fruit]
        _add_fruit(connection, capture_id, round_id, keys, capture.fruit)
    return Saved.NEW


def round_id_of(connection: Connection, key: str) -> int:
    """Find a round.

    Raises
    ------
    StoreError
        If it is not there.
    """
    query = select(Round.id).where(Round.key == checked_key(key, "round"))
    found = connection.execute(query).scalar()
    if found is None:
        raise StoreError(f"round {key} is not in the store", remedy="save the round first")
    return found


def _round_of(connection: Connection, key: str) -> tuple[int, str]:
    round_id = round_id_of(connection, key)
    return round_id, connection.execute(
        select(Round.house).where(Round.id == round_id)
    ).scalar_one()


def _insert_new(
    connection: Connection, table: type[Base], cells: dict[str, Any], *unique: str
) -> int | None:
    """Insert one line and give its id; None where one with that key is there already.

    Where another is just inserting the same key, PostgreSQL waits for its end.
    """
    dialect = sqlite if connection.dialect.name == "sqlite" else postgresql
    line = dialect.insert(table).values(**cells).on_conflict_do_nothing(index_elements=unique)
    return cast("int | None", connection.execute(line.returning(_key_column(table))).scalar())


def _key_column(table: type[Base]) -> Any:
    return next(iter(table.__table__.primary_key))


def _row_id(connection: Connection, house: str, name: str) -> int:
    query = select(Row.id).where(Row.house == house, Row.name == name)
    found = connection.execute(query).scalar()
    if found is None:
        found = _insert_new(connection, Row, {"house": house, "name": name}, "house", "name")
    return connection.execute(query).scalar_one() if found is None else found


def _add_artifacts(
    connection: Connection, stop_id: int, artifacts: Sequence[ArtifactRecord]
) -> None:
    # In one order for all, so that two writers never wait for each other in a circle.
    unique = ("kind", "name", "sha256")
    ids: dict[tuple[str, ...], int] = {}
    for record in sorted(artifacts, key=lambda a: (a.kind, a.name, a.sha256)):
        names = (record.kind, record.name, record.sha256)
        query = select(Artifact.id).where(
            *(getattr(Artifact, c) == v for c, v in zip(unique, names, strict=True))
        )
        found = connection.execute(query).scalar()
        if found is None:
            found = _insert_new(connection, Artifact, record_json(record), *unique)
        ids[names] = connection.execute(query).scalar_one() if found is None else found
    lines = [
        {"stop_id": stop_id, "number": n, "artifact_id": ids[a.kind, a.name, a.sha256]}
        for n, a in enumerate(artifacts)
    ]
    _insert_all(connection, StopArtifact, lines)


def _add_images(connection: Connection, captures: Sequence[CaptureRecord]) -> None:
    images: dict[str, ImageRef] = {}
    for capture in captures:
        for ref in (capture.color, capture.depth, capture.thumbnail):
            if ref is not None:
                images[ref.sha256] = ref
    for sha256 in sorted(images):
        _insert_new(connection, Image, vars(images[sha256]), "sha256")


def _add_capture(connection: Connection, stop_id: int, number: int, capture: CaptureRecord) -> int:
    refs = {"color": capture.color, "depth": capture.depth, "thumbnail": capture.thumbnail}
    cells = {
        **simple_cells(capture, CAPTURE_CELLS),
        "camera": dict(capture.camera),
        "provenance": dict(capture.provenance),
        **{f"{name}_sha256": ref and ref.sha256 for name, ref in refs.items()},
        "stop_id": stop_id,
        "number": number,
    }
    line = insert(CaptureLine).values(**cells).returning(CaptureLine.id)
    return connection.execute(line).scalar_one()


def _add_fruit(
    connection: Connection,
    capture_id: int,
    round_id: int,
    keys: Sequence[str],
    fruit: Sequence[FruitRecord],
) -> None:
    if not fruit:
        return
    lines = [
        {
            **simple_cells(one, FRUIT_CELLS),
            "key": key,
            "capture_id": capture_id,
            "round_id": round_id,
        }
        for key, one in zip(keys, fruit, strict=True)
    ]
    add = insert(FruitLine).returning(FruitLine.id, sort_by_parameter_order=True)
    ids = connection.execute(add, lines).scalars().all()
    masks = [
        {"fruit_id": i, "rle": one.mask, "keypoints": [list(p) for p in one.keypoints]}
        for i, one in zip(ids, fruit, strict=True)
    ]
    _insert_all(connection, MaskLine, masks)
    methods = [
        {
            **simple_cells(method, METHOD_CELLS),
            "fruit_id": i,
            "number": number,
            "path_um": pack_um(method.path_m),
            "diameter_um": pack_um(method.diameter_m),
        }
        for i, one in zip(ids, fruit, strict=True)
        for number, method in enumerate(one.methods)
    ]
    _insert_all(connection, MethodLine, methods)


def _insert_all(connection: Connection, table: type[Base], lines: list[dict[str, Any]]) -> None:
    if lines:
        connection.execute(insert(table), lines)


def _conflict(what: str, key: str) -> StoreConflictError:
    return StoreConflictError(
        f"{what} {key} is already stored with another content",
        remedy="give what differs a key of its own, from records.new_key()",
    )
