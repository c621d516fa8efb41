"""Read one stop with everything in it: captures, fruit, methods, and what measured them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sqlalchemy import select

from cucumbervision.errors import StoreError
from cucumbervision.store.cells import (
    cells_of,
    columns_of,
    decoding,
    detection_from_json,
    detection_of,
    points,
    record_of,
    unpack_um,
)
from cucumbervision.store.records import (
    ArtifactRecord,
    CaptureRecord,
    DetectionRecord,
    ImageRef,
    MethodRecord,
    StopRecord,
    checked_key,
)
from cucumbervision.store.schema import (
    CAPTURE_CELLS,
    DETECTION_CELLS,
    IMAGE_COLUMNS,
    IS_ACTIVE,
    METHOD_CELLS,
    Artifact,
    CaptureLine,
    DetectionLine,
    Image,
    Mark,
    MaskLine,
    MethodLine,
    Round,
    Row,
    StopArtifact,
    StopLine,
)

if TYPE_CHECKING:
    from sqlalchemy import Connection


def corrected_of(connection: Connection, which: Any) -> dict[str, DetectionRecord]:
    """Return corrected records with masks and methods by the detections' keys."""
    query = (
        select(DetectionLine.key, Mark.details)
        .join(DetectionLine, DetectionLine.id == Mark.fruit_id)
        .where(Mark.slot == "mask", Mark.ended_by_id.is_(None), IS_ACTIVE, which)
    )
    rows = cells_of(connection, query)
    with decoding(connection):
        return {key: detection_from_json(details) for key, details in rows}


def artifacts_of(connection: Connection, which: Any) -> dict[str, tuple[ArtifactRecord, ...]]:
    """Return what stops were measured with, in the order given, by the stops' keys."""
    query = (
        select(StopLine.key, Artifact.kind, Artifact.name, Artifact.sha256, Artifact.details)
        .join(StopArtifact, StopArtifact.stop_id == StopLine.id)
        .join(Artifact, Artifact.id == StopArtifact.artifact_id)
        .join(Round, Round.id == StopLine.round_id)
        .where(which)
        .order_by(StopLine.id, StopArtifact.number)
    )
    found: dict[str, list[ArtifactRecord]] = {}
    for key, *cells in cells_of(connection, query):
        found.setdefault(key, []).append(ArtifactRecord(*cells))
    return {key: tuple(artifacts) for key, artifacts in found.items()}


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
        select(StopLine.id, Round.key, Row.name, *columns_of(StopLine, names))
        .join(Round, Round.id == StopLine.round_id)
        .outerjoin(Row, Row.id == StopLine.row_id)
        .where(StopLine.key == key)
    )
    rows = cells_of(connection, query)
    if not rows:
        raise StoreError(f"stop {key} is not in the store", remedy="look it up in stops()")
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


def _captures_of(connection: Connection, stop_id: int) -> tuple[CaptureRecord, ...]:
    detections = _records_of(connection, stop_id)
    refs = (CaptureLine.color_sha256, CaptureLine.depth_sha256, CaptureLine.thumbnail_sha256)
    query = (
        select(CaptureLine.id, *refs, *columns_of(CaptureLine, CAPTURE_CELLS))
        .where(CaptureLine.stop_id == stop_id)
        .order_by(CaptureLine.number)
    )
    rows = cells_of(connection, query)
    wanted = {sha256 for row in rows for sha256 in row[1:4] if sha256}
    of_images = select(*IMAGE_COLUMNS).where(Image.sha256.in_(wanted))
    images = {row[0]: ImageRef(*row) for row in cells_of(connection, of_images)}
    return tuple(
        record_of(
            CaptureRecord,
            *row[4:],
            *(images.get(sha256) for sha256 in row[1:4]),
            tuple(detections.get(row[0], ())),
        )
        for row in rows
    )


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
    found: dict[int, list[DetectionRecord]] = {}
    for row in cells_of(connection, of_detections):
        with decoding(connection):
            keypoints = tuple(tuple(point) for point in row[2])
            one = detection_of(row[4:], keypoints, row[3], tuple(methods.get(row[0], ())))
        found.setdefault(row[1], []).append(one)
    return found
