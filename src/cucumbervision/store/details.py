"""Read one stop or one fruit with everything, and the log."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sqlalchemy import select
from sqlalchemy.orm import aliased

from cucumbervision.errors import StoreError
from cucumbervision.store.groups import group_fruit
from cucumbervision.store.lines import (
    CAPTURE_CELLS,
    FRUIT_CELLS,
    METHOD_CELLS,
    built,
    cells_of,
    fruit_from_json,
    image_ref,
    points,
    unpack_um,
)
from cucumbervision.store.reading import IMAGE_COLUMNS, fruit_views, link_records
from cucumbervision.store.records import (
    ArtifactRecord,
    CaptureRecord,
    FruitRecord,
    ImageRef,
    MethodRecord,
    StopRecord,
    checked_key,
)
from cucumbervision.store.schema import (
    Action,
    Artifact,
    CaptureLine,
    FruitLine,
    Image,
    Mark,
    MaskLine,
    MethodLine,
    Round,
    Row,
    StopArtifact,
    StopLine,
)
from cucumbervision.store.views import ActionView, FruitDetail

if TYPE_CHECKING:
    from sqlalchemy import Connection

__all__ = ["action_views", "fruit_detail", "stop_record"]


def stop_record(connection: Connection, key: str) -> StopRecord:
    """Give a stop as it was saved.

    Raises
    ------
    StoreError
        If it is not there.
    """
    key = checked_key(key, "stop")
    query = (
        select(StopLine, Round.key.label("round_key"), Row.name.label("row"))
        .join(Round, Round.id == StopLine.round_id)
        .outerjoin(Row, Row.id == StopLine.row_id)
        .where(StopLine.key == key)
    )
    # A Core connection gives the entity's columns one by one.
    found = connection.execute(query).mappings().one_or_none()
    if found is None:
        raise StoreError(f"stop {key} is not in the store", remedy="look it up in stops()")
    return StopRecord(
        key=key,
        round_key=found["round_key"],
        row=found["row"],
        side=found["side"],
        position_m=found["position_m"],
        position_sd_m=found["position_sd_m"],
        step=found["step"],
        taken_s=found["taken_s"],
        pose=tuple(found["pose"]),
        note=found["note"],
        captures=_captures(connection, found["id"]),
        artifacts=_artifacts(connection, found["id"]),
        failures=tuple(found["failures"]),
    )


def _artifacts(connection: Connection, stop_id: int) -> tuple[ArtifactRecord, ...]:
    query = (
        select(Artifact.kind, Artifact.name, Artifact.sha256, Artifact.details)
        .join(StopArtifact, StopArtifact.artifact_id == Artifact.id)
        .where(StopArtifact.stop_id == stop_id)
        .order_by(StopArtifact.number)
    )
    return tuple(ArtifactRecord(*row) for row in cells_of(connection, query))


def _captures(connection: Connection, stop_id: int) -> tuple[CaptureRecord, ...]:
    fruit = _fruit_of_stop(connection, stop_id)
    images = _images_of_stop(connection, stop_id)
    refs = (CaptureLine.color_sha256, CaptureLine.depth_sha256, CaptureLine.thumbnail_sha256)
    query = (
        select(CaptureLine.id, *refs, *(getattr(CaptureLine, name) for name in CAPTURE_CELLS))
        .where(CaptureLine.stop_id == stop_id)
        .order_by(CaptureLine.number)
    )
    return tuple(
        built(
            CaptureRecord,
            *row[4:],
            *(images.get(sha256) for sha256 in row[1:4]),
            tuple(fruit.get(row[0], ())),
        )
        for row in cells_of(connection, query)
    )


def _images_of_stop(connection: Connection, stop_id: int) -> dict[str, ImageRef]:
    named = select(
        CaptureLine.color_sha256, CaptureLine.depth_sha256, CaptureLine.thumbnail_sha256
    ).where(CaptureLine.stop_id == stop_id)
    wanted = {sha256 for row in connection.execute(named) for sha256 in row if sha256}
    query = select(*IMAGE_COLUMNS).where(Image.sha256.in_(wanted))
    refs = (image_ref(row) for row in cells_of(connection, query))
    return {ref.sha256: ref for ref in refs if ref is not None}


def _fruit_of_stop(connection: Connection, stop_id: int) -> dict[int, list[FruitRecord]]:
    methods: dict[int, list[MethodRecord]] = {}
    cells = (getattr(MethodLine, name) for name in METHOD_CELLS)
    of_methods = (
        select(MethodLine.fruit_id, MethodLine.path_um, MethodLine.diameter_um, *cells)
        .join(FruitLine, FruitLine.id == MethodLine.fruit_id)
        .join(CaptureLine, CaptureLine.id == FruitLine.capture_id)
        .where(CaptureLine.stop_id == stop_id)
        .order_by(MethodLine.fruit_id, MethodLine.number)
    )
    for row in cells_of(connection, of_methods):
        one = built(MethodRecord, *row[3:], points(row[1]), unpack_um(row[2]))
        methods.setdefault(row[0], []).append(one)
    of_fruit = (
        select(
            FruitLine.id,
            FruitLine.capture_id,
            MaskLine.keypoints,
            MaskLine.rle,
            *(getattr(FruitLine, name) for name in FRUIT_CELLS),
        )
        .join(CaptureLine, CaptureLine.id == FruitLine.capture_id)
        .join(MaskLine, MaskLine.fruit_id == FruitLine.id)
        .where(CaptureLine.stop_id == stop_id)
        .order_by(FruitLine.id)
    )
    fruit: dict[int, list[FruitRecord]] = {}
    for row in cells_of(connection, of_fruit):
        keypoints = tuple(tuple(point) for point in row[2])
        one_fruit = built(FruitRecord, *row[4:], keypoints, row[3], tuple(methods.get(row[0], ())))
        fruit.setdefault(row[1], []).append(one_fruit)
    return fruit


def fruit_detail(connection: Connection, key: str) -> FruitDetail:
    """Give one detection with everything.

    Raises
    ------
    StoreError
        If it is not there.
    """
    key = checked_key(key, "fruit")
    query = (
        select(FruitLine.id, FruitLine.number, CaptureLine.number, StopLine.key, Round.key)
        .join(CaptureLine, CaptureLine.id == FruitLine.capture_id)
        .join(StopLine, StopLine.id == CaptureLine.stop_id)
        .join(Round, Round.id == FruitLine.round_id)
        .where(FruitLine.key == key)
    )
    found = connection.execute(query).one_or_none()
    if found is None:
        raise StoreError(f"fruit {key} is not in the store", remedy="look it up in fruit()")
    fruit_id, number, capture_number, stop_key, round_key = found
    stop = stop_record(connection, stop_key)
    capture = stop.captures[capture_number]
    original = next(one for one in capture.fruit if one.number == number)
    all_links = link_records(connection, round_key)
    group = group_fruit({key, *(end for x in all_links for end in (x.first, x.second))}, all_links)
    views = fruit_views(connection, round_key, sorted(group[key]))
    view = next(one for one in views if one.key == key)
    corrected = _correction(connection, fruit_id)
    links = [x for x in all_links if key in (x.first, x.second)]
    log = [action for action in action_views(connection, round_key, None) if key in action.fruit]
    return FruitDetail(
        replace(view, record=corrected or original),
        original,
        capture,
        stop,
        tuple(links),
        tuple(log),
    )


def _correction(connection: Connection, fruit_id: int) -> FruitRecord | None:
    query = select(Mark.details).where(
        Mark.fruit_id == fruit_id, Mark.slot == "mask", Mark.ended_by_id.is_(None)
    )
    details = connection.execute(query).scalar()
    return None if details is None else fruit_from_json(details)


def action_views(
    connection: Connection, round_key: str | None, limit: int | None
) -> list[ActionView]:
    """List the log, the newest line first."""
    undo = aliased(Action)
    query: Any = (
        select(
            Action.id,
            Action.at_s,
            Action.by,
            Action.kind,
            Round.key,
            Action.fruit,
            Action.details,
            Action.undoes_id,
            undo.id,
        )
        .outerjoin(Round, Round.id == Action.round_id)
        .outerjoin(undo, undo.undoes_id == Action.id)
        .order_by(Action.id.desc())
        .limit(limit)
    )
    if round_key is not None:
        query = query.where(Round.key == checked_key(round_key, "round"))
    return [
        built(ActionView, *row[:5], tuple(row[5]), row[6], row[7], row[8] is not None)
        for row in cells_of(connection, query)
    ]
