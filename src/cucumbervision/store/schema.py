"""The tables, for SQLite and PostgreSQL alike.

What was measured is written once and never changed. What people and algorithms say of it later
stands in `marks`, `links` and the stops' fitted positions; every manual action is a line of
`actions`, which the database itself keeps from being changed or removed.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import (
    JSON,
    CheckConstraint,
    Double,
    ForeignKey,
    Index,
    LargeBinary,
    MetaData,
    Text,
    UniqueConstraint,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

__all__ = [
    "Action",
    "Artifact",
    "Base",
    "CaptureLine",
    "FruitLine",
    "Image",
    "Link",
    "Mark",
    "MaskLine",
    "MethodLine",
    "Round",
    "Row",
    "Shift",
    "StopArtifact",
    "StopLine",
]

_ACTIVE = text("ended_by_id IS NULL")


class Base(DeclarativeBase):
    """All tables; constraints are named, so that migrations can speak of them."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {float: Double, str: Text, dict[str, Any]: JSON, list[Any]: JSON}  # noqa: RUF012


class Round(Base):
    """One walk through a house."""

    __tablename__ = "rounds"

    id: Mapped[int] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(unique=True)
    name: Mapped[str]
    house: Mapped[str]
    started_s: Mapped[float] = mapped_column(index=True)
    profile: Mapped[str]
    note: Mapped[str]


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
    content_sha256: Mapped[str]
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
    # Where an algorithm puts the stop, from the fruit that it shares with its neighbours.
    fitted_m: Mapped[float | None]
    fitted_sd_m: Mapped[float | None]


class StopArtifact(Base):
    """Which artifacts a stop was measured with, in the order given."""

    __tablename__ = "stop_artifacts"

    stop_id: Mapped[int] = mapped_column(ForeignKey("stops.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    artifact_id: Mapped[int] = mapped_column(ForeignKey("artifacts.id"), index=True)


class CaptureLine(Base):
    """One RGB-D frame."""

    __tablename__ = "captures"
    __table_args__ = (UniqueConstraint("stop_id", "number"), UniqueConstraint("stop_id", "name"))

    id: Mapped[int] = mapped_column(primary_key=True)
    stop_id: Mapped[int] = mapped_column(ForeignKey("stops.id"))
    number: Mapped[int]
    name: Mapped[str]
    frame: Mapped[int]
    burst_frame: Mapped[int]
    burst_size: Mapped[int]
    timestamp_s: Mapped[float | None]
    width_px: Mapped[int]
    height_px: Mapped[int]
    fill: Mapped[float | None]
    simulated: Mapped[bool]
    source: Mapped[str]
    camera: Mapped[dict[str, Any]]
    provenance: Mapped[dict[str, Any]]
    depth_unit_m: Mapped[float | None]
    color_sha256: Mapped[str | None] = mapped_column(ForeignKey("images.sha256"), index=True)
    depth_sha256: Mapped[str | None] = mapped_column(ForeignKey("images.sha256"), index=True)
    thumbnail_sha256: Mapped[str | None] = mapped_column(ForeignKey("images.sha256"), index=True)


class FruitLine(Base):
    """One detected fruit of one capture, with what lists show of it.

    Round and row stand here too, so that a list of fruit needs no walk over stops and captures.
    """

    __tablename__ = "fruit"
    __table_args__ = (UniqueConstraint("capture_id", "number"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(unique=True)
    capture_id: Mapped[int] = mapped_column(ForeignKey("captures.id"))
    round_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), index=True)
    number: Mapped[int]
    label: Mapped[str]
    score: Mapped[float]
    box_x1_px: Mapped[float]
    box_y1_px: Mapped[float]
    box_x2_px: Mapped[float]
    box_y2_px: Mapped[float]
    method: Mapped[str | None]
    reason: Mapped[str]
    fallback: Mapped[str]
    flags: Mapped[str]
    length_m: Mapped[float | None]
    length_kind: Mapped[str | None]
    length_sd_m: Mapped[float | None]
    interval_low_m: Mapped[float | None]
    interval_high_m: Mapped[float | None]
    interval_of: Mapped[str | None]
    interval_basis: Mapped[str | None]
    centreline_m: Mapped[float | None]
    thread_m: Mapped[float | None]
    chord_m: Mapped[float | None]
    inner_arc_m: Mapped[float | None]
    diameter_max_m: Mapped[float | None]
    diameter_mean_m: Mapped[float | None]
    volume_m3: Mapped[float | None]
    tilt_deg: Mapped[float | None]
    hidden_share: Mapped[float | None]
    mask_source: Mapped[str | None]
    mask_px: Mapped[int | None]
    fill: Mapped[float | None]
    distance_m: Mapped[float | None]
    raw_length_m: Mapped[float | None]
    raw_length_kind: Mapped[str | None]
    centre_x_m: Mapped[float | None]
    centre_y_m: Mapped[float | None]
    centre_z_m: Mapped[float | None]
    offset_m: Mapped[float | None]
    offset_sd_m: Mapped[float | None]
    view_score: Mapped[float]


class MaskLine(Base):
    """A fruit's mask and keypoints, apart from the lists, which never need them."""

    __tablename__ = "masks"

    fruit_id: Mapped[int] = mapped_column(ForeignKey("fruit.id"), primary_key=True)
    rle: Mapped[str | None]
    keypoints: Mapped[list[Any]]


class MethodLine(Base):
    """One method on one fruit."""

    __tablename__ = "measurements"

    fruit_id: Mapped[int] = mapped_column(ForeignKey("fruit.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    method: Mapped[str]
    length_m: Mapped[float | None]
    kind: Mapped[str | None]
    reason: Mapped[str]
    fallback: Mapped[str]
    measured_by: Mapped[str | None]
    centreline_m: Mapped[float | None]
    thread_m: Mapped[float | None]
    chord_m: Mapped[float | None]
    centreline_sd_m: Mapped[float | None]
    thread_sd_m: Mapped[float | None]
    path_um: Mapped[bytes] = mapped_column(LargeBinary)
    diameter_um: Mapped[bytes] = mapped_column(LargeBinary)


class Action(Base):
    """What somebody did by hand; lines are only ever added."""

    __tablename__ = "actions"

    id: Mapped[int] = mapped_column(primary_key=True)
    at_s: Mapped[float]
    by: Mapped[str]
    kind: Mapped[str]
    round_id: Mapped[int | None] = mapped_column(ForeignKey("rounds.id"), index=True)
    fruit: Mapped[list[Any]]
    details: Mapped[dict[str, Any]]
    undoes_id: Mapped[int | None] = mapped_column(ForeignKey("actions.id"), unique=True)


class Mark(Base):
    """What somebody says of a fruit; of each slot the one that has not ended counts."""

    __tablename__ = "marks"
    __table_args__ = (
        Index(
            "uq_marks_active",
            "fruit_id",
            "slot",
            unique=True,
            sqlite_where=_ACTIVE,
            postgresql_where=_ACTIVE,
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    fruit_id: Mapped[int] = mapped_column(ForeignKey("fruit.id"), index=True)
    slot: Mapped[str]
    value: Mapped[str]
    details: Mapped[dict[str, Any]]
    action_id: Mapped[int] = mapped_column(ForeignKey("actions.id"), index=True)
    ended_by_id: Mapped[int | None] = mapped_column(ForeignKey("actions.id"), index=True)


class Link(Base):
    """Two detections of one fruit, within a round or on different days; or 'these are two'."""

    __tablename__ = "links"
    __table_args__ = (
        CheckConstraint("first_id <> second_id", name="two"),
        Index(
            "uq_links_active",
            "first_id",
            "second_id",
            unique=True,
            sqlite_where=_ACTIVE,
            postgresql_where=_ACTIVE,
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    kind: Mapped[str]
    first_id: Mapped[int] = mapped_column(ForeignKey("fruit.id"))
    second_id: Mapped[int] = mapped_column(ForeignKey("fruit.id"), index=True)
    first_round_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), index=True)
    second_round_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), index=True)
    score: Mapped[float | None]
    action_id: Mapped[int | None] = mapped_column(ForeignKey("actions.id"), index=True)
    ended_by_id: Mapped[int | None] = mapped_column(ForeignKey("actions.id"), index=True)


class Shift(Base):
    """How far a row's plants were moved between two rounds, as an algorithm estimated it."""

    __tablename__ = "shifts"

    row_id: Mapped[int] = mapped_column(ForeignKey("rows.id"), primary_key=True)
    earlier_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), primary_key=True)
    later_id: Mapped[int] = mapped_column(ForeignKey("rounds.id"), primary_key=True)
    shift_m: Mapped[float]
    sd_m: Mapped[float | None]
