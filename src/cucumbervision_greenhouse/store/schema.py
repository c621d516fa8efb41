"""The tables, for both SQLite and PostgreSQL, and the mapping of records to them.

Measurements are written once and never changed. Later decisions by people and algorithms are in
`marks`, `links` and the stops' fitted positions; the place of a stop and the name of a round can
be corrected (`corrections.py`). Every manual action is a line of `actions`, which the database
protects against change and removal.
"""

from __future__ import annotations

from dataclasses import fields
from types import UnionType
from typing import TYPE_CHECKING, Any, ClassVar, get_args, get_type_hints

from sqlalchemy import (
    JSON,
    Boolean,
    CheckConstraint,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Text,
    UniqueConstraint,
    and_,
    false,
    select,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, aliased, mapped_column

from cucumbervision_greenhouse.store.records import CaptureRecord, DetectionRecord, MethodRecord

if TYPE_CHECKING:
    from collections.abc import Sequence

_ACTIVE = text("ended_by_id IS NULL")


def _one_active(name: str, *columns: str) -> Index:
    """Return an index that allows one line which has not ended for these columns."""
    return Index(name, *columns, unique=True, sqlite_where=_ACTIVE, postgresql_where=_ACTIVE)


class JsonList(JSON):
    """JSON whose value is a list."""

    python_type = list


class JsonObject(JSON):
    """JSON whose value is an object."""

    python_type = dict


class Base(DeclarativeBase):
    """All tables; constraints have names."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map: ClassVar[dict[Any, Any]] = {
        float: Double,
        str: Text,
        dict[str, Any]: JsonObject,
        list[Any]: JsonList,
    }


class RoundLine(Base):
    """One walk through a house."""

    __tablename__ = "rounds"

    id: Mapped[int] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(unique=True)
    name: Mapped[str]
    house: Mapped[str]
    started_s: Mapped[float] = mapped_column(index=True)
    profile: Mapped[str]
    note: Mapped[str]
    deleted: Mapped[bool] = mapped_column(server_default=false())
    sha256: Mapped[str] = mapped_column(default="")


class Row(Base):
    """A row of a house; it stays while rounds come and go."""

    __tablename__ = "rows"
    __table_args__ = (UniqueConstraint("house", "name"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    house: Mapped[str]
    name: Mapped[str]


class Artifact(Base):
    """A model, calibration or configuration, by its hash."""

    __tablename__ = "artifacts"
    __table_args__ = (UniqueConstraint("kind", "name", "sha256"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    kind: Mapped[str]
    name: Mapped[str]
    sha256: Mapped[str]
    details: Mapped[dict[str, Any]]


class Image(Base):
    """A picture beside the database."""

    __tablename__ = "images"

    sha256: Mapped[str] = mapped_column(primary_key=True)
    suffix: Mapped[str]
    size_bytes: Mapped[int]
    width_px: Mapped[int]
    height_px: Mapped[int]


class StopLine(Base):
    """One stop of a round."""

    __tablename__ = "stops"

    id: Mapped[int] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(unique=True)
    content_sha256: Mapped[str] = mapped_column(default="")
    round_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), index=True)
    row_id: Mapped[int | None] = mapped_column(ForeignKey("rows.id"), index=True)
    side: Mapped[str | None]
    position_m: Mapped[float | None]
    position_sd_m: Mapped[float | None]
    step: Mapped[int | None]
    taken_s: Mapped[float]
    pose: Mapped[list[Any]]
    note: Mapped[str]
    failures: Mapped[list[Any]]
    rows_sha256: Mapped[str] = mapped_column(server_default="")
    # Where an algorithm puts the stop, from the fruit that it shares with its neighbours.
    fitted_m: Mapped[float | None]
    fitted_sd_m: Mapped[float | None]
    sha256: Mapped[str] = mapped_column(default="")
    # Whether its offsets along the row count the other way: its side was corrected later.
    mirrored: Mapped[bool] = mapped_column(server_default=false())
    deleted: Mapped[bool] = mapped_column(server_default=false())


class StopArtifact(Base):
    """Which artifacts a stop was measured with, in the order given."""

    __tablename__ = "stop_artifacts"

    stop_id: Mapped[int] = mapped_column(ForeignKey("stops.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    artifact_id: Mapped[int] = mapped_column(ForeignKey("artifacts.id"), index=True)


class CaptureLine(Base):
    """One RGB-D frame; the other columns are the fields of `CaptureRecord`."""

    __tablename__ = "captures"
    __table_args__ = (UniqueConstraint("stop_id", "number"), UniqueConstraint("stop_id", "name"))

    id: Mapped[int] = mapped_column(primary_key=True)
    stop_id: Mapped[int] = mapped_column(ForeignKey("stops.id"))
    number: Mapped[int]
    name: Mapped[str]
    simulated: Mapped[bool]
    camera: Mapped[dict[str, Any]]
    gravity: Mapped[list[Any] | None] = mapped_column(JsonList(none_as_null=True))
    doubts: Mapped[list[Any] | None] = mapped_column(JsonList(none_as_null=True))
    color_sha256: Mapped[str | None] = mapped_column(ForeignKey("images.sha256"), index=True)
    depth_sha256: Mapped[str | None] = mapped_column(ForeignKey("images.sha256"), index=True)
    thumbnail_sha256: Mapped[str | None] = mapped_column(ForeignKey("images.sha256"), index=True)


class DetectionLine(Base):
    """One detected fruit of one capture; the other columns are the fields of `DetectionRecord`.

    Its `length` and `raw_length` are several columns each, under the names of the tables. The round
    is here too, so that a list needs no join over stops and captures.
    """

    __tablename__ = "fruit"
    __table_args__ = (UniqueConstraint("capture_id", "number"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(unique=True)
    capture_id: Mapped[int] = mapped_column(ForeignKey("captures.id"))
    round_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), index=True)
    number: Mapped[int]
    length_m: Mapped[float | None]
    length_kind: Mapped[str | None]
    interval_low_m: Mapped[float | None]
    interval_high_m: Mapped[float | None]
    interval_of: Mapped[str | None]
    interval_basis: Mapped[str | None]
    raw_length_m: Mapped[float | None]
    raw_length_kind: Mapped[str | None]
    raw_interval_low_m: Mapped[float | None]
    raw_interval_high_m: Mapped[float | None]
    raw_interval_of: Mapped[str | None]
    raw_interval_basis: Mapped[str | None]


class MaskLine(Base):
    """A fruit's mask and keypoints, apart from the lists, which never need them."""

    __tablename__ = "masks"

    fruit_id: Mapped[int] = mapped_column(ForeignKey("fruit.id"), primary_key=True)
    rle: Mapped[str | None]
    keypoints: Mapped[list[Any]]


class MethodLine(Base):
    """One method on one detection; the other columns are the fields of `MethodRecord`."""

    __tablename__ = "measurements"

    fruit_id: Mapped[int] = mapped_column(ForeignKey("fruit.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    path_um: Mapped[bytes] = mapped_column(LargeBinary)
    diameter_um: Mapped[bytes] = mapped_column(LargeBinary)


class Action(Base):
    """An action by hand; lines are only ever added."""

    __tablename__ = "actions"

    id: Mapped[int] = mapped_column(primary_key=True)
    at_s: Mapped[float]
    by: Mapped[str]
    kind: Mapped[str]
    round_id: Mapped[int | None] = mapped_column(ForeignKey("rounds.id"), index=True)
    fruit: Mapped[list[Any]]
    details: Mapped[dict[str, Any]]
    sha256: Mapped[str] = mapped_column(default="")
    undoes_id: Mapped[int | None] = mapped_column(ForeignKey("actions.id"), unique=True)


class Mark(Base):
    """A mark on a detection, made by hand; of each slot the one that has not ended counts."""

    __tablename__ = "marks"
    __table_args__ = (_one_active("uq_marks_active", "fruit_id", "slot"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    fruit_id: Mapped[int] = mapped_column(ForeignKey("fruit.id"), index=True)
    slot: Mapped[str]
    value: Mapped[str]
    details: Mapped[dict[str, Any]]
    sha256: Mapped[str] = mapped_column(default="")
    action_id: Mapped[int] = mapped_column(ForeignKey("actions.id"), index=True)
    ended_by_id: Mapped[int | None] = mapped_column(ForeignKey("actions.id"), index=True)


class LinkLine(Base):
    """Two detections of one fruit, within a round or on different days; or 'these are two'."""

    __tablename__ = "links"
    __table_args__ = (
        CheckConstraint("first_id <> second_id", name="two"),
        _one_active("uq_links_active", "first_id", "second_id"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    kind: Mapped[str]
    first_id: Mapped[int] = mapped_column(ForeignKey("fruit.id"))
    second_id: Mapped[int] = mapped_column(ForeignKey("fruit.id"), index=True)
    first_round_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), index=True)
    second_round_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), index=True)
    score: Mapped[float | None]
    sha256: Mapped[str] = mapped_column(default="")
    action_id: Mapped[int | None] = mapped_column(ForeignKey("actions.id"), index=True)
    ended_by_id: Mapped[int | None] = mapped_column(ForeignKey("actions.id"), index=True)


class JointLine(Base):
    """The joint measurement of one fruit in several views."""

    __tablename__ = "joint_measurements"

    id: Mapped[int] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(unique=True)
    round_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), index=True)
    first: Mapped[str]
    views: Mapped[int]
    reason: Mapped[str]
    record: Mapped[dict[str, Any] | None]
    drawing: Mapped[dict[str, Any]]
    sha256: Mapped[str] = mapped_column(default="")


ADDED = "added"
"""The slot of a mark on a fruit that was added by hand."""


def is_active(fruit: Any = DetectionLine) -> Any:
    """Return whether a detection counts, for a query.

    All do but those that were added by hand and taken back, and those of deleted stops.
    """
    mark, capture, stop = aliased(Mark), aliased(CaptureLine), aliased(StopLine)
    taken_back = select(mark.fruit_id).where(mark.slot == ADDED, mark.ended_by_id.is_not(None))
    gone = select(capture.id).join(stop, stop.id == capture.stop_id).where(stop.deleted)
    return and_(fruit.id.not_in(taken_back), fruit.capture_id.not_in(gone))


IS_ACTIVE = is_active()
"""`is_active` of the detections themselves."""

_TYPES = {float: Double, int: Integer, str: Text, bool: Boolean}


def _lay_out(table: type[Base], record: type, leave_out: Sequence[str]) -> tuple[str, ...]:
    """Add a column for each field of a record that is not there yet; return all their names."""
    hints = get_type_hints(record)
    names = tuple(field.name for field in fields(record) if field.name not in leave_out)
    for name in names:
        hint = hints[name]
        kinds = set(get_args(hint)) if isinstance(hint, UnionType) else {hint}
        if not hasattr(table, name):
            sql = next((_TYPES[kind] for kind in kinds if kind in _TYPES), JsonObject)
            setattr(table, name, mapped_column(sql, nullable=type(None) in kinds))
    return names


CAPTURE_CELLS = _lay_out(CaptureLine, CaptureRecord, ("color", "depth", "thumbnail", "fruit"))
LENGTH_CELLS = (
    *("length_m", "length_kind"),
    *("interval_low_m", "interval_high_m", "interval_of", "interval_basis"),
)
RAW_LENGTH_CELLS = tuple(f"raw_{name}" for name in LENGTH_CELLS)
DETECTION_CELLS = (
    *_lay_out(
        DetectionLine, DetectionRecord, ("length", "raw_length", "keypoints", "mask", "methods")
    ),
    *LENGTH_CELLS,
    *RAW_LENGTH_CELLS,
)
METHOD_CELLS = _lay_out(MethodLine, MethodRecord, ("path_m", "diameter_m"))
ROUND_CELLS = ("key", "name", "house", "started_s", "profile", "note")
IMAGE_COLUMNS = (Image.sha256, Image.suffix, Image.size_bytes, Image.width_px, Image.height_px)
