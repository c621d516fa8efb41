"""The tables, for SQLite and PostgreSQL; those of a fruit's row are the columns of `fields.csv`.

Measurements are written once and never changed. What people decide is a line of `marks`, what an
algorithm decides one of `links` and the stops' fitted positions. `migrations` brings the tables of
earlier versions here.
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from cucumbervision.run.fields import STORED_FIELDS

VERSION = "4"
"""Of the tables: of the newest step in `migrations`."""

METADATA = sa.MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)

_TYPES: Any = {"text": sa.Text, "whole": sa.Integer, "number": sa.Double, "yes/no": sa.Boolean}


def _id() -> sa.Column[int]:
    return sa.Column("id", sa.Integer, primary_key=True)


def _needed(name: str, kind: Any, **options: Any) -> sa.Column[Any]:
    return sa.Column(name, kind, nullable=False, **options)


def _line_of(
    name: str, table: str, *, index: bool = True, nullable: bool = False
) -> sa.Column[int]:
    return sa.Column(name, sa.Integer, sa.ForeignKey(f"{table}.id"), index=index, nullable=nullable)


ROUNDS = sa.Table(
    "rounds",
    METADATA,
    _id(),
    _needed("key", sa.Text, unique=True),
    *(_needed(name, sa.Text) for name in ("name", "house", "profile", "note")),
    _needed("started_s", sa.Double, index=True),
    _needed("deleted", sa.Boolean, server_default=sa.false()),
)
"""Walks through a house."""

STOPS = sa.Table(
    "stops",
    METADATA,
    _id(),
    _needed("key", sa.Text, unique=True),
    _line_of("round_id", "rounds"),
    *(sa.Column(name, sa.Text) for name in ("row", "side")),
    *(sa.Column(name, sa.Double) for name in ("position_m", "position_sd_m")),
    sa.Column("step", sa.Integer),
    _needed("taken_s", sa.Double),
    _needed("note", sa.Text),
    *(_needed(name, sa.JSON) for name in ("pose", "failures", "artifacts")),
    # Where an algorithm puts it, from the fruit that it shares with its neighbours.
    *(sa.Column(name, sa.Double) for name in ("fitted_m", "fitted_sd_m")),
    # Whether its offsets along the row count the other way: its side was corrected later.
    _needed("mirrored", sa.Boolean, server_default=sa.false()),
    _needed("deleted", sa.Boolean, server_default=sa.false()),
)
"""Stops of a round."""

CAPTURES = sa.Table(
    "captures",
    METADATA,
    _id(),
    _line_of("stop_id", "stops", index=False),
    _needed("number", sa.Integer),
    _needed("name", sa.Text),
    _needed("simulated", sa.Boolean),
    *(sa.Column(name, sa.Text, index=True) for name in ("color", "depth", "thumbnail")),
    _needed("record", sa.JSON),
    sa.UniqueConstraint("stop_id", "number"),
    sa.UniqueConstraint("stop_id", "name"),
)
"""RGB-D frames of a stop; `record` is what is no column."""

FRUIT = sa.Table(
    "fruit",
    METADATA,
    _id(),
    _needed("key", sa.Text, unique=True),
    _line_of("capture_id", "captures", index=False),
    _line_of("round_id", "rounds"),
    _needed("deleted", sa.Boolean, server_default=sa.false()),
    *(sa.Column(name, sa.Double) for name in ("offset_m", "offset_sd_m")),
    *(sa.Column(column.si_name, _TYPES[column.type]) for column in STORED_FIELDS),
    sa.UniqueConstraint("capture_id", "fruit"),
)
"""Fruit of a capture, each its row in SI units."""

SHAPES = sa.Table(
    "shapes",
    METADATA,
    sa.Column("fruit_id", sa.Integer, sa.ForeignKey("fruit.id"), primary_key=True),
    sa.Column("mask", sa.Text),
    _needed("record", sa.JSON),
)
"""A fruit's mask, keypoints and path, apart from its row: lists do not need them."""

MARKS = sa.Table(
    "marks",
    METADATA,
    _id(),
    _needed("at_s", sa.Double),
    *(_needed(name, sa.Text) for name in ("by", "kind")),
    _line_of("round_id", "rounds", nullable=True),
    *(_needed(name, sa.JSON) for name in ("fruit", "details")),
    sa.Column("undoes_id", sa.Integer, sa.ForeignKey("marks.id"), unique=True),
)
"""What people decided, in order; lines are only ever added."""

LINKS = sa.Table(
    "links",
    METADATA,
    _id(),
    _needed("kind", sa.Text),
    *(_line_of(f"{end}_id", "fruit") for end in ("first", "second")),
    *(_line_of(f"{end}_round_id", "rounds") for end in ("first", "second")),
    sa.Column("score", sa.Double),
    sa.CheckConstraint("first_id <> second_id", name="two"),
)
"""Two detections of one fruit, within a round or on two days, as an algorithm found them."""
