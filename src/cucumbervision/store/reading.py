"""Read lists: rounds, stops, fruit, links; each a handful of indexed queries."""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING, Any

from sqlalchemy import and_, func, or_, select
from sqlalchemy.orm import aliased

from cucumbervision.store.groups import Candidate, Standing, standings
from cucumbervision.store.lines import (
    FRUIT_CELLS,
    METHOD_CELLS,
    built,
    cells_of,
    fruit_from_json,
    image_ref,
)
from cucumbervision.store.records import FruitRecord, MethodRecord, RoundRecord
from cucumbervision.store.schema import (
    CaptureLine,
    FruitLine,
    Image,
    Link,
    Mark,
    MethodLine,
    Round,
    Row,
    Shift,
    StopLine,
)
from cucumbervision.store.views import (
    CameraAt,
    FruitView,
    LinkKind,
    LinkRecord,
    RoundView,
    ShiftRecord,
    StopView,
    Verdict,
)
from cucumbervision.store.writing import round_id_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sqlalchemy import Connection

__all__ = [
    "IMAGE_COLUMNS",
    "cameras_at",
    "fruit_views",
    "link_records",
    "method_records",
    "round_views",
    "shift_records",
    "stop_views",
]

_IN_ORDER = (StopLine.taken_s, StopLine.id, CaptureLine.number, FruitLine.number)
IMAGE_COLUMNS = (Image.sha256, Image.suffix, Image.size_bytes, Image.width_px, Image.height_px)


def round_views(connection: Connection, house: str | None) -> list[RoundView]:
    """List rounds, the newest first."""
    stops = (
        select(StopLine.round_id, func.count().label("n"), func.max(StopLine.taken_s).label("last"))
        .group_by(StopLine.round_id)
        .subquery()
    )
    fruit = (
        select(FruitLine.round_id, func.count().label("n")).group_by(FruitLine.round_id).subquery()
    )
    query = (
        select(
            Round.key,
            Round.name,
            Round.house,
            Round.started_s,
            Round.profile,
            Round.note,
            func.coalesce(stops.c.n, 0),
            func.coalesce(fruit.c.n, 0),
            stops.c.last,
        )
        .outerjoin(stops, stops.c.round_id == Round.id)
        .outerjoin(fruit, fruit.c.round_id == Round.id)
        .order_by(Round.started_s.desc(), Round.id.desc())
    )
    if house is not None:
        query = query.where(Round.house == house)
    return [RoundView(RoundRecord(*row[:6]), *row[6:]) for row in cells_of(connection, query)]


def stop_views(connection: Connection, round_key: str) -> list[StopView]:
    """List a round's stops in the order in which they were made."""
    round_id = round_id_of(connection, round_key)
    in_round = StopLine.round_id == round_id
    captures = (
        select(CaptureLine.stop_id, func.count().label("n"))
        .join(StopLine, StopLine.id == CaptureLine.stop_id)
        .where(in_round)
        .group_by(CaptureLine.stop_id)
        .subquery()
    )
    fruit = (
        select(CaptureLine.stop_id, func.count().label("n"))
        .join(FruitLine, FruitLine.capture_id == CaptureLine.id)
        .where(FruitLine.round_id == round_id)
        .group_by(CaptureLine.stop_id)
        .subquery()
    )
    first = aliased(CaptureLine)
    query = (
        select(
            StopLine.key,
            Row.name,
            StopLine.side,
            StopLine.position_m,
            StopLine.position_sd_m,
            StopLine.fitted_m,
            StopLine.fitted_sd_m,
            StopLine.step,
            StopLine.taken_s,
            StopLine.note,
            func.coalesce(captures.c.n, 0),
            func.coalesce(fruit.c.n, 0),
            StopLine.failures,
            *IMAGE_COLUMNS,
        )
        .outerjoin(Row, Row.id == StopLine.row_id)
        .outerjoin(captures, captures.c.stop_id == StopLine.id)
        .outerjoin(fruit, fruit.c.stop_id == StopLine.id)
        .outerjoin(first, and_(first.stop_id == StopLine.id, first.number == 0))
        .outerjoin(Image, Image.sha256 == first.thumbnail_sha256)
        .where(in_round)
        .order_by(StopLine.taken_s, StopLine.id)
    )
    return [
        built(StopView, row[0], round_key, *row[1:12], len(row[12]), image_ref(row[13:18]))
        for row in cells_of(connection, query)
    ]


def fruit_views(
    connection: Connection, round_key: str, keys: Sequence[str] | None = None
) -> list[FruitView]:
    """List a round's detections in the order of its stops, marks and groups among them.

    `keys` gives those alone; their groups are right where all members are among them.
    """
    round_id = round_id_of(connection, round_key)
    marks = _active_marks(connection, round_id)
    query = _fruit_query(round_id)
    if keys is not None:
        query = query.where(FruitLine.key.in_(keys))
    rows = [
        (row, marks.get(row[0], {})) for row in cells_of(connection, query.order_by(*_IN_ORDER))
    ]
    records = {row[0]: said.get("mask") or FruitRecord(*row[17:]) for row, said in rows}
    candidates = {
        row[0]: Candidate(
            said.get("verdict") is not Verdict.REJECTED,
            records[row[0]].length_m is not None,
            records[row[0]].view_score,
        )
        for row, said in rows
    }
    picked = {row[0]: said["picked"] for row, said in rows if "picked" in said}
    groups = standings(candidates, picked, link_records(connection, round_key))
    return [
        _fruit_view(row, round_key, records[row[0]], said, groups[row[0]]) for row, said in rows
    ]


def _fruit_query(round_id: int) -> Any:
    return (
        select(
            FruitLine.key,
            StopLine.key,
            CaptureLine.name,
            Row.name,
            StopLine.side,
            StopLine.step,
            StopLine.taken_s,
            CaptureLine.simulated,
            StopLine.position_m,
            StopLine.position_sd_m,
            StopLine.fitted_m,
            StopLine.fitted_sd_m,
            *IMAGE_COLUMNS,
            *(getattr(FruitLine, name) for name in FRUIT_CELLS),
        )
        .join(CaptureLine, CaptureLine.id == FruitLine.capture_id)
        .join(StopLine, StopLine.id == CaptureLine.stop_id)
        .outerjoin(Row, Row.id == StopLine.row_id)
        .outerjoin(Image, Image.sha256 == CaptureLine.thumbnail_sha256)
        .where(FruitLine.round_id == round_id)
    )


def _fruit_view(
    row: Sequence[Any],
    round_key: str,
    record: FruitRecord,
    marks: dict[str, Any],
    group: Standing,
) -> FruitView:
    given, given_sd, fitted, fitted_sd = row[8:12]
    at, sd = (given, given_sd) if fitted is None else (fitted, fitted_sd)
    return built(
        FruitView,
        *row[:2],
        round_key,
        *row[2:8],
        *_along(at, sd, record),
        image_ref(row[12:17]),
        record,
        marks.get("verdict"),
        group.picked_s,
        "mask" in marks,
        group.best,
        group.views,
    )


def _along(
    at_m: float | None, sd_m: float | None, fruit: FruitRecord
) -> tuple[float | None, float | None]:
    if at_m is None:
        return None, None
    if sd_m is None:
        return at_m + (fruit.offset_m or 0.0), None
    return at_m + (fruit.offset_m or 0.0), hypot(sd_m, fruit.offset_sd_m or 0.0)


def _active_marks(connection: Connection, round_id: int) -> dict[str, dict[str, Any]]:
    query = (
        select(FruitLine.key, Mark.slot, Mark.value, Mark.details)
        .join(FruitLine, FruitLine.id == Mark.fruit_id)
        .where(FruitLine.round_id == round_id, Mark.ended_by_id.is_(None))
    )
    verdicts = {str(verdict): verdict for verdict in Verdict}
    marks: dict[str, dict[str, Any]] = {}
    for key, slot, value, details in cells_of(connection, query):
        said: Any = verdicts[value] if slot == "verdict" else details.get("at_s")
        if slot == "mask":
            corrected = fruit_from_json(details)
            said = FruitRecord(**{name: getattr(corrected, name) for name in FRUIT_CELLS})
        marks.setdefault(key, {})[slot] = said
    return marks


def link_records(
    connection: Connection, round_key: str, kind: LinkKind | None = None
) -> list[LinkRecord]:
    """List the links that have not ended and touch a round."""
    round_id = round_id_of(connection, round_key)
    first, second = aliased(FruitLine), aliased(FruitLine)
    query = (
        select(Link.kind, first.key, second.key, Link.score, Link.action_id)
        .join(first, first.id == Link.first_id)
        .join(second, second.id == Link.second_id)
        .where(
            Link.ended_by_id.is_(None),
            or_(Link.first_round_id == round_id, Link.second_round_id == round_id),
        )
        .order_by(Link.id)
    )
    if kind is not None:
        query = query.where(Link.kind == str(kind))
    kinds = {str(one): one for one in LinkKind}
    return [
        LinkRecord(kinds[row[0]], row[1], row[2], row[3], row[4] is not None)
        for row in cells_of(connection, query)
    ]


def shift_records(connection: Connection, later_key: str) -> list[ShiftRecord]:
    """List how far rows were moved between earlier rounds and this one."""
    earlier, later = aliased(Round), aliased(Round)
    query = (
        select(Row.name, earlier.key, later.key, Shift.shift_m, Shift.sd_m)
        .join(Row, Row.id == Shift.row_id)
        .join(earlier, earlier.id == Shift.earlier_id)
        .join(later, later.id == Shift.later_id)
        .where(later.id == round_id_of(connection, later_key))
        .order_by(Row.name, earlier.started_s)
    )
    return [ShiftRecord(*row) for row in cells_of(connection, query)]


def method_records(connection: Connection, round_key: str) -> dict[str, tuple[MethodRecord, ...]]:
    """Give every method's measurement of a round's detections by fruit key, without the paths."""
    query = (
        select(FruitLine.key, *(getattr(MethodLine, name) for name in METHOD_CELLS))
        .join(FruitLine, FruitLine.id == MethodLine.fruit_id)
        .where(FruitLine.round_id == round_id_of(connection, round_key))
        .order_by(MethodLine.fruit_id, MethodLine.number)
    )
    found: dict[str, list[MethodRecord]] = {}
    for row in cells_of(connection, query):
        found.setdefault(row[0], []).append(MethodRecord(*row[1:]))
    return {key: tuple(methods) for key, methods in found.items()}


def cameras_at(connection: Connection, round_key: str) -> dict[str, CameraAt]:
    """Give poses, cameras and captures' numbers by the stops' keys."""
    query = (
        select(StopLine.key, StopLine.pose, CaptureLine.id, CaptureLine.name, CaptureLine.camera)
        .join(Round, Round.id == StopLine.round_id)
        .outerjoin(CaptureLine, CaptureLine.stop_id == StopLine.id)
        .where(Round.key == round_key)
        .order_by(StopLine.id, CaptureLine.number)
    )
    found: dict[str, CameraAt] = {}
    numbers: dict[str, dict[str, int]] = {}
    for key, pose, number, name, camera in connection.execute(query):
        if key not in found:
            numbers[key] = {}
            found[key] = CameraAt(pose, numbers[key], camera or {})
        if number is not None:
            numbers[key][name] = number
    return found
