"""Read rounds, stops, detections, links and the log; each list a handful of indexed queries."""

from __future__ import annotations

from dataclasses import replace
from math import hypot
from typing import TYPE_CHECKING, Any

from sqlalchemy import and_, func, or_, select
from sqlalchemy.orm import aliased

from cucumbervision.errors import StoreError
from cucumbervision_greenhouse.store.cells import (
    cells_of,
    columns_of,
    decoding,
    detection_from_json,
    detection_of,
    image_ref,
    record_of,
    round_id_of,
)
from cucumbervision_greenhouse.store.engine import Database
from cucumbervision_greenhouse.store.links import (
    Candidate,
    FruitGroup,
    LinkKind,
    LinkRecord,
    group_detections,
    representative_views,
)
from cucumbervision_greenhouse.store.records import (
    ArtifactRecord,
    DetectionRecord,
    MethodRecord,
    Round,
    StopRecord,
    checked_key,
)
from cucumbervision_greenhouse.store.schema import (
    ADDED,
    DETECTION_CELLS,
    IMAGE_COLUMNS,
    IS_ACTIVE,
    METHOD_CELLS,
    ROUND_CELLS,
    Action,
    CaptureLine,
    DetectionLine,
    Image,
    LinkLine,
    Mark,
    MethodLine,
    RoundLine,
    Row,
    StopLine,
    is_active,
)
from cucumbervision_greenhouse.store.stop_content import artifacts_of, read_stop
from cucumbervision_greenhouse.store.views import (
    CameraAt,
    DetectionDetail,
    DetectionFilter,
    DetectionSummary,
    LogEntry,
    RoundSummary,
    StopSummary,
    Verdict,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sqlalchemy import ColumnElement, Connection


_PLACE = ("position_m", "position_sd_m", "fitted_m", "fitted_sd_m")
_IN_ORDER = (StopLine.taken_s, StopLine.id, CaptureLine.number, DetectionLine.number)
# Once, since an alias reads all columns of its table when it is first used.
_ONE, _OTHER = aliased(DetectionLine), aliased(DetectionLine)
_BOTH_ACTIVE = and_(is_active(_ONE), is_active(_OTHER))
_FIRST_CAPTURE = aliased(CaptureLine)


_UNDONE_AMONG = 500  # newest lines of the log
NOT_UNDONE = ("undo", "measure-again")
"""Kinds of action that cannot be undone; stores before 0.2 have stops measured again in place."""


class Queries(Database):
    """What a store can be asked. Each method sees the database as it was when it began."""

    def rounds(self, *, deleted: bool = False) -> list[RoundSummary]:
        """Return the rounds, the newest first.

        `deleted` gives those that were deleted instead.
        """
        return self._summaries(RoundLine.deleted == deleted)

    def round(self, key: str) -> RoundSummary | None:
        """Return a round; None where it is not there or was deleted.

        Much faster than `rounds`, which counts the fruit of all.
        """
        try:
            key = checked_key(key, "round")
        except StoreError:  # no round has such a key
            return None
        return next(iter(self._summaries(~RoundLine.deleted, RoundLine.key == key)), None)

    def _summaries(self, *only: ColumnElement[bool]) -> list[RoundSummary]:
        of_round = and_(StopLine.round_id == RoundLine.id, ~StopLine.deleted)
        query = select(
            *columns_of(RoundLine, ROUND_CELLS),
            select(func.count(StopLine.id)).where(of_round).scalar_subquery(),
            select(func.count(DetectionLine.id))
            .where(DetectionLine.round_id == RoundLine.id, IS_ACTIVE)
            .scalar_subquery(),
            select(func.max(StopLine.taken_s)).where(of_round).scalar_subquery(),
        ).order_by(RoundLine.started_s.desc(), RoundLine.id.desc())
        with self.reading() as connection:
            rows = cells_of(connection, query.where(*only))
            return [RoundSummary(Round(*row[:6]), *row[6:]) for row in rows]

    def stop_is_deleted(self, key: str) -> bool | None:
        """Return whether a stop was deleted; None where it never was in the store."""
        query = select(StopLine.deleted).where(StopLine.key == checked_key(key, "stop"))
        with self.reading() as connection:
            return connection.execute(query).scalar()

    def stops(self, round_key: str) -> list[StopSummary]:
        """Return a round's stops in the order in which they were made."""
        with self.reading() as connection:
            rows = cells_of(connection, _stop_query(round_id_of(connection, round_key)))
            return [
                record_of(
                    StopSummary, row[0], round_key, *row[1:13], len(row[13]), image_ref(row[14:19])
                )
                for row in rows
            ]

    def detections(
        self, round_key: str, only: DetectionFilter | None = None
    ) -> list[DetectionSummary]:
        """Return a round's detections in the order of its stops, or those that a filter keeps.

        `DetectionFilter(best=True)` gives every fruit once, however often it was seen.
        """
        with self.reading() as connection:
            views = _detections_of(connection, round_key)
        return views if only is None else [view for view in views if only.keeps(view)]

    def detection(self, key: str) -> DetectionDetail:
        """Return one detection with everything: mask, methods, paths, capture, links and log.

        Raises
        ------
        StoreError
            If it is not there.
        """
        key = checked_key(key, "fruit")
        of_round = select(RoundLine.key).join(DetectionLine, DetectionLine.round_id == RoundLine.id)
        with self.reading() as connection:
            round_query = of_round.where(DetectionLine.key == key, IS_ACTIVE)
            round_key = connection.execute(round_query).scalar()
            if round_key is None:
                raise StoreError(
                    "fruit {key} is not in the store", remedy="look it up in detections()", key=key
                )
            links = links_of(connection, round_key)
            ends = {key, *(end for link in links for end in (link.first, link.second))}
            group = group_detections(ends, links)[key]
            views = _detections_of(connection, round_key, sorted(group))
            with decoding(connection):  # a line may have lost those that it is part of
                [view] = [candidate for candidate in views if candidate.key == key]
            stop = read_stop(connection, view.stop_key)
            corrected = corrected_of(connection, DetectionLine.key == key).get(key)
            log = _actions_of(connection, round_key, None)
            with decoding(connection):
                [capture] = [
                    stop_capture
                    for stop_capture in stop.captures
                    if stop_capture.name == view.capture
                ]
                [original] = [
                    record for record in capture.fruit if record.number == view.record.number
                ]
        return DetectionDetail(
            view=replace(view, record=corrected or original),
            original=original,
            capture=capture,
            stop=stop,
            links=tuple(link for link in links if key in (link.first, link.second)),
            log=tuple(action for action in log if key in action.fruit),
        )

    def picked(self, round_key: str) -> dict[str, float]:
        """Return the times of picking by the detections' keys."""
        with self.reading() as connection:
            marks = _marks_of(connection, round_id_of(connection, round_key), "picked")
            return {key: values["picked"] for key, values in marks.items()}

    def newest_action(self, round_key: str, without: Sequence[str] = ()) -> int:
        """Return the number of a round's newest line in the log; 0 where it has none.

        Parameters
        ----------
        round_key : str
            The round.
        without : sequence of str
            Kinds of action that do not matter.
        """
        with self.reading() as connection:
            newest_query = select(func.max(Action.id)).where(
                Action.round_id == round_id_of(connection, round_key), Action.kind.not_in(without)
            )
            return int(connection.execute(newest_query).scalar() or 0)

    def measurements(self, round_key: str) -> dict[str, tuple[MethodRecord, ...]]:
        """Return every method's first measurement by the detections' keys, without the paths."""
        of_fruit: dict[str, list[MethodRecord]] = {}
        with self.reading() as connection:
            query = (
                select(DetectionLine.key, *columns_of(MethodLine, METHOD_CELLS))
                .join(DetectionLine, DetectionLine.id == MethodLine.fruit_id)
                .where(DetectionLine.round_id == round_id_of(connection, round_key), IS_ACTIVE)
                .order_by(MethodLine.fruit_id, MethodLine.number)
            )
            for row in cells_of(connection, query):
                of_fruit.setdefault(row[0], []).append(MethodRecord(*row[1:]))
        return {key: tuple(methods) for key, methods in of_fruit.items()}

    def corrected(self, round_key: str) -> dict[str, DetectionRecord]:
        """Return the corrected records, masks included, by the keys of their detections."""
        with self.reading() as connection:
            which = DetectionLine.round_id == round_id_of(connection, round_key)
            return corrected_of(connection, which)

    def cameras(self, round_key: str) -> dict[str, CameraAt]:
        """Return the cameras of a round and their poses, by the stops' keys."""
        query = (
            select(
                *columns_of(StopLine, ("key", "pose", "mirrored")),
                *columns_of(CaptureLine, ("id", "name", "camera")),
            )
            .join(RoundLine, RoundLine.id == StopLine.round_id)
            .outerjoin(CaptureLine, CaptureLine.stop_id == StopLine.id)
            .where(RoundLine.key == round_key, ~StopLine.deleted)
            .order_by(StopLine.id, CaptureLine.number)
        )
        camera_of: dict[str, CameraAt] = {}
        with self.reading() as connection, decoding(connection):
            for key, camera_pose, mirrored, number, name, camera in cells_of(connection, query):
                pose = (
                    [*(-x for x in camera_pose[:3]), *camera_pose[3:]] if mirrored else camera_pose
                )
                camera_at = camera_of.setdefault(key, CameraAt(pose, {}, camera or {}))
                if number is not None:
                    camera_at.captures[name] = number
        return camera_of

    def artifacts(self, round_key: str) -> dict[str, tuple[ArtifactRecord, ...]]:
        """Return the artifacts that the stops of a round were measured with, by the stops' keys."""
        with self.reading() as connection:
            return artifacts_of(connection, and_(RoundLine.key == round_key, ~StopLine.deleted))

    def stop(self, stop_key: str) -> StopRecord:
        """Return a stop with all its data: as it was saved, but at its corrected place.

        Its pose is the one that it was saved with; `cameras` gives it mirrored where the stop is.

        Raises
        ------
        StoreError
            If it is not there.
        """
        with self.reading() as connection:
            return read_stop(connection, stop_key)

    def links(self, round_key: str, kind: LinkKind | None = None) -> list[LinkRecord]:
        """Return the links that touch a round; of growth both from earlier and to later rounds."""
        with self.reading() as connection:
            return links_of(connection, round_key, kind)

    def log(self, round_key: str | None = None, *, limit: int | None = 200) -> list[LogEntry]:
        """Return the log of actions by hand, the newest first."""
        with self.reading() as connection:
            return _actions_of(connection, round_key, limit)

    def own_actions(self, round_key: str) -> list[LogEntry]:
        """Return the actions in a round that the store's signer can undo, the newest first.

        That is what was done by that person from that device. Without any: what was done by nobody
        in particular, as by a command.
        """
        with self.reading() as connection:
            of_round = select(DetectionLine.key).where(
                DetectionLine.round_id == round_id_of(connection, round_key)
            )
            fruit = set(connection.execute(of_round).scalars())
            lines = [
                line
                for line in _actions_of(connection, None, _UNDONE_AMONG)
                if not line.undone
                and line.kind not in NOT_UNDONE
                # Growth is logged in the later of two rounds.
                and (line.round_key == round_key or not fruit.isdisjoint(line.fruit))
            ]
        device = [(line.details.get("device", ""), line.by) for line in lines]
        person_lines = [
            x for x, by in zip(lines, device, strict=True) if by == (self._device, self._signed_by)
        ]
        return person_lines or [x for x, by in zip(lines, device, strict=True) if by == ("", "")]


def links_of(
    connection: Connection, round_key: str, kind: LinkKind | None = None
) -> list[LinkRecord]:
    """Return the links that have not ended and touch a round."""
    round_id = round_id_of(connection, round_key)
    query = (
        select(LinkLine.kind, _ONE.key, _OTHER.key, LinkLine.score, LinkLine.action_id)
        .join(_ONE, _ONE.id == LinkLine.first_id)
        .join(_OTHER, _OTHER.id == LinkLine.second_id)
        .where(
            LinkLine.ended_by_id.is_(None),
            or_(LinkLine.first_round_id == round_id, LinkLine.second_round_id == round_id),
            _BOTH_ACTIVE,
        )
        .order_by(LinkLine.id)
    )
    if kind is not None:
        query = query.where(LinkLine.kind == str(kind))
    kinds = {str(kind): kind for kind in LinkKind}
    rows = cells_of(connection, query)
    with decoding(connection):
        return [
            LinkRecord(
                kind=kinds[row[0]],
                first=row[1],
                second=row[2],
                score=row[3],
                by_hand=row[4] is not None,
            )
            for row in rows
        ]


def _stop_query(round_id: int) -> Any:
    captures = select(func.count(CaptureLine.id)).where(CaptureLine.stop_id == StopLine.id)
    detections = (
        select(func.count(DetectionLine.id))
        .join(CaptureLine, CaptureLine.id == DetectionLine.capture_id)
        .where(CaptureLine.stop_id == StopLine.id, IS_ACTIVE)
    )
    return (
        select(
            StopLine.key,
            Row.name,
            *columns_of(StopLine, ("side", *_PLACE, "step", "taken_s", "note", "mirrored")),
            captures.scalar_subquery(),
            detections.scalar_subquery(),
            StopLine.failures,
            *IMAGE_COLUMNS,
        )
        .outerjoin(Row, Row.id == StopLine.row_id)
        .outerjoin(
            _FIRST_CAPTURE, and_(_FIRST_CAPTURE.stop_id == StopLine.id, _FIRST_CAPTURE.number == 0)
        )
        .outerjoin(Image, Image.sha256 == _FIRST_CAPTURE.thumbnail_sha256)
        .where(StopLine.round_id == round_id, ~StopLine.deleted)
        .order_by(StopLine.taken_s, StopLine.id)
    )


def _detections_of(
    connection: Connection, round_key: str, keys: Sequence[str] | None = None
) -> list[DetectionSummary]:
    """Return a round's detections in the order of its stops, with marks and groups.

    `keys` gives those alone; their groups are right where all members are among them.
    """
    round_id = round_id_of(connection, round_key)
    marks = _marks_of(connection, round_id)
    query = _detection_query(round_id)
    if keys is not None:
        query = query.where(DetectionLine.key.in_(keys))
    rows = [
        (row, marks.get(row[0], {})) for row in cells_of(connection, query.order_by(*_IN_ORDER))
    ]
    with decoding(connection):
        records = {row[0]: marks.get("mask") or detection_of(row[18:]) for row, marks in rows}
    candidates = {
        row[0]: Candidate(
            marks.get("verdict") is not Verdict.REJECTED,
            records[row[0]].length_m is not None,
            not records[row[0]].partial,
            records[row[0]].view_score,
        )
        for row, marks in rows
    }
    picked = {row[0]: marks["picked"] for row, marks in rows if "picked" in marks}
    groups = representative_views(candidates, picked, links_of(connection, round_key))
    return [
        _detection_view(row, round_key, records[row[0]], marks, groups[row[0]])
        for row, marks in rows
    ]


def _detection_query(round_id: int) -> Any:
    return (
        select(
            DetectionLine.key,
            StopLine.key,
            CaptureLine.name,
            Row.name,
            *columns_of(StopLine, ("side", "step", "taken_s")),
            CaptureLine.simulated,
            *columns_of(StopLine, (*_PLACE, "mirrored")),
            *IMAGE_COLUMNS,
            *columns_of(DetectionLine, DETECTION_CELLS),
        )
        .join(CaptureLine, CaptureLine.id == DetectionLine.capture_id)
        .join(StopLine, StopLine.id == CaptureLine.stop_id)
        .outerjoin(Row, Row.id == StopLine.row_id)
        .outerjoin(Image, Image.sha256 == CaptureLine.thumbnail_sha256)
        .where(DetectionLine.round_id == round_id, IS_ACTIVE)
    )


def _detection_view(
    row: Sequence[Any],
    round_key: str,
    record: DetectionRecord,
    marks: Mapping[str, Any],
    group: FruitGroup,
) -> DetectionSummary:
    stated_m, stated_sd_m, fitted, fitted_sd, mirrored = row[8:13]
    stop_m, stop_sd_m = (stated_m, stated_sd_m) if fitted is None else (fitted, fitted_sd)
    offset_m = (record.offset_m or 0.0) * (-1.0 if mirrored else 1.0)
    along_m = None if stop_m is None else stop_m + offset_m
    sd_known = stop_m is not None and stop_sd_m is not None
    return record_of(
        DetectionSummary,
        *row[:2],
        round_key,
        *row[2:8],
        along_m,
        hypot(stop_sd_m, record.offset_sd_m or 0.0) if sd_known else None,
        image_ref(row[13:18]),
        record,
        marks.get("verdict"),
        group.picked_s,
        "mask" in marks,
        group.best,
        group.views,
    )


def _marks_of(
    connection: Connection, round_id: int, slot: str | None = None
) -> dict[str, dict[str, Any]]:
    """Return verdict, time of picking and corrected record by the detections' keys.

    `slot` gives that alone.
    """
    query = (
        select(DetectionLine.key, Mark.slot, Mark.value, Mark.details)
        .join(DetectionLine, DetectionLine.id == Mark.fruit_id)
        .where(DetectionLine.round_id == round_id, Mark.ended_by_id.is_(None))
    )
    if slot is not None:
        query = query.where(Mark.slot == slot)
    verdicts = {str(verdict): verdict for verdict in Verdict}
    marks: dict[str, dict[str, Any]] = {}
    rows = cells_of(connection, query.where(Mark.slot != ADDED))
    with decoding(connection):
        for key, slot, value, details in rows:
            mark: Any = verdicts[value] if slot == "verdict" else details.get("at_s")
            if slot == "mask":
                mark = replace(detection_from_json(details), keypoints=(), mask=None, methods=())
            marks.setdefault(key, {})[slot] = mark
    return marks


def _actions_of(connection: Connection, round_key: str | None, limit: int | None) -> list[LogEntry]:
    undo = aliased(Action)
    query: Any = (
        select(
            *columns_of(Action, ("id", "at_s", "by", "kind")),
            RoundLine.key,
            *columns_of(Action, ("fruit", "details")),
            undo.id,
        )
        .outerjoin(RoundLine, RoundLine.id == Action.round_id)
        .outerjoin(undo, undo.undoes_id == Action.id)
        .order_by(Action.id.desc())
        .limit(limit)
    )
    if round_key is not None:
        query = query.where(RoundLine.key == checked_key(round_key, "round"))
    return [
        record_of(LogEntry, *row[:5], tuple(row[5]), row[6], row[7] is not None)
        for row in cells_of(connection, query)
    ]


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
