"""Hashes of what is stored, which stay the same when the software learns a new trait.

A stop's hash is of all that was measured there and of where that was: its line, captures, fruit,
masks, methods and artifacts, as the database gives them back. Rounds, corrections, links, the log,
joint measurements and where merging put a stop have a hash a line.

A hash covers the record and not the columns that this version knows: the columns of the first
version come in their order of that time, and every later column by its name where it is not empty.
So a store stays sound when a column is added to it, and older software can verify a stop that
newer software wrote.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

from sqlalchemy import JSON, bindparam, inspect, literal_column, or_, select, update

from cucumbervision_greenhouse.store.cells import cells_of, columns_of
from cucumbervision_greenhouse.store.records import record_json
from cucumbervision_greenhouse.store.schema import (
    ROUND_CELLS,
    Action,
    Artifact,
    CaptureLine,
    DetectionLine,
    Image,
    JointLine,
    LinkLine,
    Mark,
    MaskLine,
    MethodLine,
    RoundLine,
    Row,
    StopArtifact,
    StopLine,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sqlalchemy import Connection

# The columns of 0.1.0 in the order of their hashes. Never changed: stored hashes are of them.
_FIRST_COLUMNS: dict[Any, tuple[str, ...]] = {
    StopLine: (
        *("id", "key", "content_sha256", "round_id", "row_id", "side", "position_m"),
        *("position_sd_m", "step", "taken_s", "pose", "note", "failures", "mirrored", "deleted"),
    ),
    Artifact: ("id", "kind", "name", "sha256", "details"),
    CaptureLine: (
        *("id", "stop_id", "number", "name", "simulated", "camera", "color_sha256"),
        *("depth_sha256", "thumbnail_sha256", "frame", "burst_frame", "burst_size"),
        *("timestamp_s", "width_px", "height_px", "fill", "source", "provenance", "depth_unit_m"),
    ),
    Image: ("sha256", "suffix", "size_bytes", "width_px", "height_px"),
    DetectionLine: (
        *("id", "key", "capture_id", "round_id", "number", "length_m", "length_kind"),
        *("interval_low_m", "interval_high_m", "interval_of", "interval_basis", "raw_length_m"),
        *("raw_length_kind", "label", "score", "box_x1_px", "box_y1_px", "box_x2_px"),
        *("box_y2_px", "method", "reason", "fallback", "flags", "centreline_m", "thread_m"),
        *("chord_m", "inner_arc_m", "diameter_max_m", "diameter_mean_m", "volume_m3", "tilt_deg"),
        *("hidden_share", "mask_source", "mask_px", "fill", "distance_m", "stem_x_m", "stem_y_m"),
        *("stem_z_m", "blossom_x_m", "blossom_y_m", "blossom_z_m", "stem_confidence", "cut_x_m"),
        *("cut_y_m", "cut_z_m", "cut_xx_m2", "cut_xy_m2", "cut_xz_m2", "cut_yy_m2", "cut_yz_m2"),
        *("cut_zz_m2", "centre_x_m", "centre_y_m", "centre_z_m", "offset_m", "offset_sd_m"),
        "view_score",
    ),
    MaskLine: ("fruit_id", "rle", "keypoints"),
    MethodLine: (
        *("fruit_id", "number", "path_um", "diameter_um", "method", "length_m", "kind", "reason"),
        *("fallback", "measured_by", "centreline_m", "thread_m", "chord_m", "centreline_sd_m"),
        "thread_sd_m",
    ),
}
# Of a stop's line these change after it was measured, and are hashed elsewhere or not at all.
_NOT_HASHED = {"rows_sha256", "fitted_m", "fitted_sd_m", "sha256"}
# Records that name nothing under one of these are hashed with that name; under a later one without.
_FIRST_EMPTY_FIELDS = {name for names in _FIRST_COLUMNS.values() for name in names} | {
    *("row", "color", "depth", "thumbnail", "length", "raw_length", "mask"),
    *("low_m", "high_m", "of", "basis"),
}


def sha256_of(*values: Any) -> str:
    """Return the SHA-256 of values that are JSON or bytes, hexadecimal.

    Examples
    --------
    >>> sha256_of("verdict", {"at_s": 1.5}) == sha256_of("verdict", {"at_s": 1.25})
    False
    """
    text = json.dumps(values, sort_keys=True, ensure_ascii=False, default=bytes.hex)
    return hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()


def content_sha256(record: Any) -> str:
    """Return the SHA-256 of a record's content: equal records have equal hashes.

    A field that was added after 0.1.0 and is None changes nothing.

    Raises
    ------
    StoreError
        If the record holds a number that is not finite, or a value that JSON has not.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import DetectionRecord
    >>> content_sha256(DetectionRecord(1)) == content_sha256(DetectionRecord(2))
    False
    """
    record_json(record)  # refuses what cannot be stored
    text = json.dumps(_content_of(record), sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _content_of(value: Any) -> Any:
    """Return a record as JSON values, without the later fields that are None."""
    if is_dataclass(value):
        pairs = ((field.name, getattr(value, field.name)) for field in fields(value))
        return {
            name: _content_of(content)
            for name, content in pairs
            if content is not None or name in _FIRST_EMPTY_FIELDS
        }
    return [_content_of(item) for item in value] if isinstance(value, tuple | list) else value


def seal_stops(connection: Connection, which: Any) -> None:
    """Update the hash of all lines of some stops; call it after every change of them.

    Parameters
    ----------
    connection : Connection
        In the transaction that changes them.
    which : SQL expression
        Which lines of `StopLine`.
    """
    ids = connection.execute(select(StopLine.id).where(which)).scalars().all()
    for stop_id, sha256 in stop_hashes(connection, ids).items():
        line = update(StopLine).where(StopLine.id == stop_id)
        connection.execute(line.values(rows_sha256=sha256))


def stop_hashes(connection: Connection, stop_ids: Sequence[int]) -> dict[int, str]:
    """Return the hashes of all lines of stops, by the stops' numbers."""
    digests = {stop_id: hashlib.sha256() for stop_id in stop_ids}
    for query, later in _lines_of(connection, stop_ids):
        for stop_id, *cells in cells_of(connection, query):
            first, added = cells[: len(cells) - len(later)], cells[len(cells) - len(later) :]
            pairs = [pair for pair in zip(later, added, strict=True) if pair[1] is not None]
            digests[stop_id].update(sha256_of(*first, *pairs).encode())
    return {stop_id: digest.hexdigest() for stop_id, digest in digests.items()}


def _lines_of(
    connection: Connection, stop_ids: Sequence[int]
) -> Iterator[tuple[Any, Sequence[str]]]:
    """Yield queries of all lines of stops, each line with its stop's number first.

    With each query come the names of its last columns, which were added after 0.1.0.
    """

    def line(table: Any, *leading: Any) -> Any:
        added = _later_columns(connection, table)
        return select(*leading, *columns_of(table, _FIRST_COLUMNS[table]), *added.values())

    def later(table: Any) -> Sequence[str]:
        return list(_later_columns(connection, table))

    query = line(StopLine, StopLine.id, Row.name).outerjoin(Row, Row.id == StopLine.row_id)
    yield query.where(StopLine.id.in_(stop_ids)), later(StopLine)
    query = line(Artifact, StopArtifact.stop_id, StopArtifact.number)
    query = query.join(Artifact, Artifact.id == StopArtifact.artifact_id)
    ordered = query.order_by(StopArtifact.stop_id, StopArtifact.number)
    yield ordered.where(StopArtifact.stop_id.in_(stop_ids)), later(Artifact)
    in_stops, stop = CaptureLine.stop_id.in_(stop_ids), CaptureLine.stop_id
    query = line(CaptureLine, stop).where(in_stops).order_by(CaptureLine.id)
    yield query, later(CaptureLine)
    names = (CaptureLine.color_sha256, CaptureLine.depth_sha256, CaptureLine.thumbnail_sha256)
    query = line(Image, stop).join(Image, or_(*(Image.sha256 == name for name in names)))
    yield query.where(in_stops).order_by(CaptureLine.id, Image.sha256), later(Image)
    in_capture = CaptureLine.id == DetectionLine.capture_id
    query = line(DetectionLine, stop).join(CaptureLine, in_capture)
    yield query.where(in_stops).order_by(DetectionLine.id), later(DetectionLine)
    for table in (MaskLine, MethodLine):
        query = line(table, stop).join(DetectionLine, DetectionLine.id == table.fruit_id)
        query = query.join(CaptureLine, in_capture).where(in_stops)
        yield query.order_by(*table.__table__.primary_key), later(table)


class _AnyJson(JSON):
    """JSON of any kind."""

    python_type = object


def _later_columns(connection: Connection, table: Any) -> dict[str, Any]:
    """Return a table's columns in the database that 0.1.0 did not have, by their names.

    Newer software may have added some that this one does not know. They are read once a connection.
    """
    name = table.__tablename__
    cache: dict[str, dict[str, Any]] = connection.info.setdefault("later_columns", {})
    if name not in cache:
        first, columns = {*_FIRST_COLUMNS[table], *_NOT_HASHED}, {}
        for column in inspect(connection).get_columns(name):
            if column["name"] not in first:
                kind = _AnyJson() if isinstance(column["type"], JSON) else column["type"]
                unknown = literal_column(f'{name}."{column["name"]}"', kind)
                columns[column["name"]] = getattr(table, column["name"], unknown)
        cache[name] = dict(sorted(columns.items()))
    return cache[name]


# Of tables whose lines have a hash each: their name, and the columns that it is of.
HASHED_LINES: dict[Any, tuple[str, tuple[str, ...]]] = {
    RoundLine: ("round", (*ROUND_CELLS, "deleted")),
    StopLine: ("position of stop", ("key", "fitted_m", "fitted_sd_m")),
    Mark: ("correction", ("fruit_id", "slot", "value", "details", "action_id", "ended_by_id")),
    LinkLine: (
        "link",
        (
            *("kind", "first_id", "second_id", "first_round_id", "second_round_id", "score"),
            *("action_id", "ended_by_id"),
        ),
    ),
    Action: (
        "line of the log",
        ("at_s", "by", "kind", "round_id", "fruit", "details", "undoes_id"),
    ),
    JointLine: (
        "joint measurement",
        ("key", "round_id", "first", "views", "reason", "record", "drawing"),
    ),
}


def with_hash(table: Any, cells: dict[str, Any]) -> dict[str, Any]:
    """Return the cells of a new line of a table whose lines have a hash each, with that hash."""
    columns = columns_of(table, HASHED_LINES[table][1])
    values = [_as_stored(column, cells.get(column.name)) for column in columns]
    return {**cells, "sha256": sha256_of(*values)}


def _as_stored(column: Any, value: Any) -> Any:
    """Return a cell's value as the database gives it back: 1 is 1.0 among floats."""
    return float(value) if value is not None and column.type.python_type is float else value


def change(connection: Connection, table: Any, which: Any, **values: Any) -> int:
    """Change lines of a table whose lines have a hash each; return how many.

    Parameters
    ----------
    connection : Connection
        In a transaction.
    table : type
        The table.
    which : SQL expression
        Which of its lines; no other transaction changes them until this one ends.
    **values
        What they get.
    """
    names = HASHED_LINES[table][1]
    query = select(table.id, *columns_of(table, names)).where(which)
    lines = cells_of(connection, query.with_for_update(key_share=True))
    changed = [
        {
            "line": line,
            "hash": with_hash(table, {**dict(zip(names, cells, strict=True)), **values})["sha256"],
        }
        for line, *cells in lines
    ]
    if changed:
        statement = update(table).where(table.id == bindparam("line"))
        connection.execute(statement.values(**values, sha256=bindparam("hash")), changed)
    return len(changed)
