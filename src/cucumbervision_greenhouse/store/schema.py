"""The tables, for SQLite and PostgreSQL; those of a fruit's row are the columns of `fields.csv`.

Measurements are written once and never changed. What people decide is a line of `marks`, what an
algorithm decides one of `links` and the stops' fitted positions. `migrations` brings the tables of
earlier versions here.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import (
    JSON,
    Boolean,
    CheckConstraint,
    Column,
    Double,
    ForeignKey,
    Integer,
    MetaData,
    Table,
    Text,
    UniqueConstraint,
    false,
)

from cucumbervision.run.fields import STORED_FIELDS

VERSION = "4"
"""Of the tables: of the newest step in `migrations`."""

METADATA = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)

_TYPES: dict[str, Any] = {"text": Text, "whole": Integer, "number": Double, "yes/no": Boolean}


def _id() -> Column[int]:
    return Column("id", Integer, primary_key=True)


def _needed(name: str, kind: Any, **options: Any) -> Column[Any]:
    return Column(name, kind, nullable=False, **options)


def _line_of(name: str, table: str, *, index: bool = True, nullable: bool = False) -> Column[int]:
    return Column(name, Integer, ForeignKey(f"{table}.id"), index=index, nullable=nullable)


ROUNDS = Table(
    "rounds",
    METADATA,
    _id(),
    _needed("key", Text, unique=True),
    *(_needed(name, Text) for name in ("name", "house", "profile", "note")),
    _needed("started_s", Double, index=True),
    _needed("deleted", Boolean, server_default=false()),
)
"""Walks through a house."""

STOPS = Table(
    "stops",
    METADATA,
    _id(),
    _needed("key", Text, unique=True),
    _line_of("round_id", "rounds"),
    *(Column(name, Text) for name in ("row", "side")),
    *(Column(name, Double) for name in ("position_m", "position_sd_m")),
    Column("step", Integer),
    _needed("taken_s", Double),
    _needed("note", Text),
    *(_needed(name, JSON) for name in ("pose", "failures", "artifacts")),
    # Where an algorithm puts it, from the fruit that it shares with its neighbours.
    *(Column(name, Double) for name in ("fitted_m", "fitted_sd_m")),
    # Whether its offsets along the row count the other way: its side was corrected later.
    _needed("mirrored", Boolean, server_default=false()),
    _needed("deleted", Boolean, server_default=false()),
)
"""Stops of a round."""

CAPTURES = Table(
    "captures",
    METADATA,
    _id(),
    _line_of("stop_id", "stops", index=False),
    _needed("number", Integer),
    _needed("name", Text),
    _needed("simulated", Boolean),
    *(Column(name, Text, index=True) for name in ("color", "depth", "thumbnail")),
    _needed("record", JSON),
    UniqueConstraint("stop_id", "number"),
    UniqueConstraint("stop_id", "name"),
)
"""RGB-D frames of a stop; `record` is what is no column."""

FRUIT = Table(
    "fruit",
    METADATA,
    _id(),
    _needed("key", Text, unique=True),
    _line_of("capture_id", "captures", index=False),
    _line_of("round_id", "rounds"),
    _needed("deleted", Boolean, server_default=false()),
    *(Column(name, Double) for name in ("offset_m", "offset_sd_m")),
    *(Column(column.si_name, _TYPES[column.type]) for column in STORED_FIELDS),
    UniqueConstraint("capture_id", "fruit"),
)
"""Fruit of a capture, each its row in SI units."""

SHAPES = Table(
    "shapes",
    METADATA,
    Column("fruit_id", Integer, ForeignKey("fruit.id"), primary_key=True),
    Column("mask", Text),
    _needed("record", JSON),
)
"""A fruit's mask, keypoints and path, apart from its row: lists do not need them."""

MARKS = Table(
    "marks",
    METADATA,
    _id(),
    _needed("at_s", Double),
    *(_needed(name, Text) for name in ("by", "kind")),
    _line_of("round_id", "rounds", nullable=True),
    *(_needed(name, JSON) for name in ("fruit", "details")),
    Column("undoes_id", Integer, ForeignKey("marks.id"), unique=True),
)
"""What people decided, in order; lines are only ever added."""

LINKS = Table(
    "links",
    METADATA,
    _id(),
    _needed("kind", Text),
    *(_line_of(f"{end}_id", "fruit") for end in ("first", "second")),
    *(_line_of(f"{end}_round_id", "rounds") for end in ("first", "second")),
    Column("score", Double),
    CheckConstraint("first_id <> second_id", name="two"),
)
"""Two detections of one fruit, within a round or on two days, as an algorithm found them."""
