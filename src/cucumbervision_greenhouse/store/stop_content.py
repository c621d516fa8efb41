"""Write one stop with all its content to the tables, and read it back."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from sqlalchemy import insert, select

from cucumbervision.errors import StoreError
from cucumbervision.names import checked_name
from cucumbervision_greenhouse.store.cells import (
    cells_by_name,
    cells_of,
    columns_of,
    decoding,
    detection_cells,
    detection_of,
    id_of,
    insert_all,
    insert_new,
    pack_um,
    points,
    record_of,
    unpack_um,
)
from cucumbervision_greenhouse.store.records import (
    ArtifactRecord,
    CaptureRecord,
    DetectionRecord,
    ImageRef,
    MethodRecord,
    StopRecord,
    checked_key,
    record_json,
)
from cucumbervision_greenhouse.store.schema import (
    CAPTURE_CELLS,
    DETECTION_CELLS,
    IMAGE_COLUMNS,
    IS_ACTIVE,
    METHOD_CELLS,
    Artifact,
    CaptureLine,
    DetectionLine,
    Image,
    MaskLine,
    MethodLine,
    RoundLine,
    Row,
    StopArtifact,
    StopLine,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sqlalchemy import Connection

    from cucumbervision_greenhouse.store.corrections import StopPlace


LARGEST_STEP = 2**31 - 1  # of a column of whole numbers in PostgreSQL


def check_place(place: StopRecord | StopPlace) -> None:
    """Check the row, side, name and number of a stop: every database takes them alike.

    Raises
    ------
    NameRefusedError
        If a name cannot be read.
    StoreError
        If the number is too large.
    """
    named = {"row": place.row, "side": place.side, "stop's name": place.note}
    for what, name in named.items():
        checked_name(name or "", what)
    if abs(place.step or 0) > LARGEST_STEP:
        raise StoreError(
            f"a stop has no number {place.step}", remedy=f"at most {LARGEST_STEP} are taken"
        )


def checked_stop(stop: StopRecord) -> StopRecord:
    """Return a stop with its keys in canonical form, after checking its names.

    Texts that are no names, such as the files that captures are from, are made readable.
    """
    check_place(stop)
    for capture in stop.captures:
        checked_name(capture.name, "capture's name", longest=None)
    stop = replace(
        stop,
        key=checked_key(stop.key, "stop"),
        round_key=checked_key(stop.round_key, "round"),
        captures=tuple(
            replace(
                capture, source=_storable(capture.source), provenance=_storable(capture.provenance)
            )
            for capture in stop.captures
        ),
        artifacts=tuple(
            replace(artifact, name=_storable(artifact.name), details=_storable(artifact.details))
            for artifact in stop.artifacts
        ),
        failures=_storable(stop.failures),
    )
    _check_once([capture.name for capture in stop.captures], stop.key, "captures are called")
    for capture in stop.captures:
        _check_once([fruit.number for fruit in capture.fruit], capture.name, "fruit have number")
    return stop


ValueT = TypeVar("ValueT")


def _storable(value: ValueT) -> ValueT:
    """Return JSON values with a question mark for what no database takes.

    That is a null, and half of a surrogate pair, as which Python reads the bytes of a file's name
    that are no text.
    """
    if isinstance(value, str):
        return type(value)(value.encode(errors="replace").decode().replace("\0", "?"))
    if isinstance(value, Mapping):
        return {_storable(name): _storable(part) for name, part in value.items()}  # type: ignore[return-value]
    if isinstance(value, list | tuple):
        return type(value)(_storable(part) for part in value)
    return value


def _check_once(names: Sequence[object], source: str, what: str) -> None:
    double = next((name for name, times in Counter(names).items() if times > 1), None)
    if double is not None:
        raise StoreError(f"two {what} {double}", source=source, remedy="give each its own")


def add_content(
    connection: Connection,
    stop_id: int,
    round_id: int,
    stop: StopRecord,
    keys: Sequence[Sequence[str]],
) -> None:
    """Add a stop's artifacts, captures and fruit; the fruit's keys by capture."""
    _add_artifacts(connection, stop_id, stop.artifacts)
    _add_images(connection, stop.captures)
    for number, (capture, detection_keys) in enumerate(zip(stop.captures, keys, strict=True)):
        capture_id = _add_capture(connection, stop_id, number, capture)
        add_detections(connection, capture_id, round_id, detection_keys, capture.fruit)


def _add_artifacts(
    connection: Connection, stop_id: int, artifacts: Sequence[ArtifactRecord]
) -> None:
    unique = ("kind", "name", "sha256")
    # In one order for all, so that two writers never wait for each other in a circle.
    ids = {
        number: id_of(connection, Artifact, record_json(artifacts[number]), *unique)
        for number in sorted(
            range(len(artifacts)),
            key=lambda n: [getattr(artifacts[n], column) for column in unique],
        )
    }
    lines = [
        {"stop_id": stop_id, "number": number, "artifact_id": ids[number]} for number in sorted(ids)
    ]
    insert_all(connection, StopArtifact, lines)


def _add_images(connection: Connection, captures: Sequence[CaptureRecord]) -> None:
    refs = (
        ref for capture in captures for ref in (capture.color, capture.depth, capture.thumbnail)
    )
    images = {ref.sha256: ref for ref in refs if ref is not None}
    for sha256 in sorted(images):
        insert_new(connection, Image, vars(images[sha256]), "sha256")


def _add_capture(connection: Connection, stop_id: int, number: int, capture: CaptureRecord) -> int:
    refs = {"color": capture.color, "depth": capture.depth, "thumbnail": capture.thumbnail}
    cells = {
        **cells_by_name(capture, CAPTURE_CELLS),
        "camera": dict(capture.camera),
        "provenance": dict(capture.provenance),
        "gravity": capture.gravity and list(capture.gravity),
        "doubts": capture.doubts and list(capture.doubts),
        **{f"{name}_sha256": ref and ref.sha256 for name, ref in refs.items()},
        "stop_id": stop_id,
        "number": number,
    }
    line = insert(CaptureLine).values(**cells).returning(CaptureLine.id)
    return connection.execute(line).scalar_one()


def add_detections(
    connection: Connection,
    capture_id: int,
    round_id: int,
    keys: Sequence[str],
    records: Sequence[DetectionRecord],
) -> None:
    """Add fruit of a capture under these keys, with their masks and methods."""
    if not records:
        return
    lines = [
        {**detection_cells(record), "key": key, "capture_id": capture_id, "round_id": round_id}
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
            **cells_by_name(method, METHOD_CELLS),
            "fruit_id": i,
            "number": number,
            "path_um": pack_um(method.path_m),
            "diameter_um": pack_um(method.diameter_m),
        }
        for i, record in zip(ids, records, strict=True)
        for number, method in enumerate(record.methods)
    ]
    insert_all(connection, MethodLine, methods)


def read_stop(connection: Connection, key: str) -> StopRecord:
    """Return a stop as it was saved, but where people put it since.

    Raises
    ------
    StoreError
        If it is not there.
    """
    key = checked_key(key, "stop")
    names = ("side", "position_m", "position_sd_m", "step", "taken_s", "note", "pose", "failures")
    query = (
        select(StopLine.id, RoundLine.key, Row.name, *columns_of(StopLine, names))
        .join(RoundLine, RoundLine.id == StopLine.round_id)
        .outerjoin(Row, Row.id == StopLine.row_id)
        .where(StopLine.key == key)
    )
    rows = cells_of(connection, query)
    if not rows:
        raise StoreError("stop {key} is not in the store", remedy="look it up in stops()", key=key)
    stop_id, round_key, row, *cells = rows[0]
    values = dict(zip(names, cells, strict=True))
    return StopRecord(
        key,
        round_key,
        row,
        **{**values, "pose": tuple(values["pose"]), "failures": tuple(values["failures"])},
        captures=_captures_of(connection, stop_id),
        artifacts=artifacts_of(connection, StopLine.key == key).get(key, ()),
    )


def artifacts_of(connection: Connection, which: Any) -> dict[str, tuple[ArtifactRecord, ...]]:
    """Return what stops were measured with, in the order given, by the stops' keys."""
    query = (
        select(StopLine.key, Artifact.kind, Artifact.name, Artifact.sha256, Artifact.details)
        .join(StopArtifact, StopArtifact.stop_id == StopLine.id)
        .join(Artifact, Artifact.id == StopArtifact.artifact_id)
        .join(RoundLine, RoundLine.id == StopLine.round_id)
        .where(which)
        .order_by(StopLine.id, StopArtifact.number)
    )
    of_stop: dict[str, list[ArtifactRecord]] = {}
    for key, *cells in cells_of(connection, query):
        of_stop.setdefault(key, []).append(ArtifactRecord(*cells))
    return {key: tuple(artifacts) for key, artifacts in of_stop.items()}


def _captures_of(connection: Connection, stop_id: int) -> tuple[CaptureRecord, ...]:
    detections = _records_of(connection, stop_id)
    refs = (CaptureLine.color_sha256, CaptureLine.depth_sha256, CaptureLine.thumbnail_sha256)
    query = (
        select(CaptureLine.id, *refs, *columns_of(CaptureLine, CAPTURE_CELLS))
        .where(CaptureLine.stop_id == stop_id)
        .order_by(CaptureLine.number)
    )
    rows = cells_of(connection, query)
    digests = {sha256 for row in rows for sha256 in row[1:4] if sha256}
    of_images = select(*IMAGE_COLUMNS).where(Image.sha256.in_(digests))
    images = {row[0]: ImageRef(*row) for row in cells_of(connection, of_images)}
    return tuple(
        _capture_of(
            dict(zip(CAPTURE_CELLS, row[4:], strict=True)),
            [images.get(sha256) for sha256 in row[1:4]],
            tuple(detections.get(row[0], ())),
        )
        for row in rows
    )


def _capture_of(
    cells: dict[str, Any], pictures: Sequence[ImageRef | None], fruit: tuple[DetectionRecord, ...]
) -> CaptureRecord:
    color, depth, thumbnail = pictures
    lists = {name: cells[name] and tuple(cells[name]) for name in ("gravity", "doubts")}
    cells = cells | lists
    return CaptureRecord(**cells, color=color, depth=depth, thumbnail=thumbnail, fruit=fruit)


def _records_of(connection: Connection, stop_id: int) -> dict[int, list[DetectionRecord]]:
    """Return the detections of a stop with masks and methods, by their captures' numbers."""
    of_methods = (
        select(
            MethodLine.fruit_id,
            MethodLine.path_um,
            MethodLine.diameter_um,
            *columns_of(MethodLine, METHOD_CELLS),
        )
        .join(DetectionLine, DetectionLine.id == MethodLine.fruit_id)
        .join(CaptureLine, CaptureLine.id == DetectionLine.capture_id)
        .where(CaptureLine.stop_id == stop_id)
        .order_by(MethodLine.fruit_id, MethodLine.number)
    )
    methods: dict[int, list[MethodRecord]] = {}
    for row in cells_of(connection, of_methods):
        with decoding(connection):
            line_m, diameter_m = points(row[1]), unpack_um(row[2])
        methods.setdefault(row[0], []).append(record_of(MethodRecord, *row[3:], line_m, diameter_m))
    of_detections = (
        select(
            DetectionLine.id,
            DetectionLine.capture_id,
            MaskLine.keypoints,
            MaskLine.rle,
            *columns_of(DetectionLine, DETECTION_CELLS),
        )
        .join(CaptureLine, CaptureLine.id == DetectionLine.capture_id)
        .join(MaskLine, MaskLine.fruit_id == DetectionLine.id)
        .where(CaptureLine.stop_id == stop_id, IS_ACTIVE)
        .order_by(DetectionLine.id)
    )
    records: dict[int, list[DetectionRecord]] = {}
    for row in cells_of(connection, of_detections):
        with decoding(connection):
            keypoints = tuple(tuple(point) for point in row[2])
            record = detection_of(row[4:], keypoints, row[3], tuple(methods.get(row[0], ())))
        records.setdefault(row[1], []).append(record)
    return records
