"""Steps between the versions of the tables, by Alembic's operations.

`docs/store.md` has a table of what moved where.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa
from alembic import op

from cucumbervision.run.options import GRAVITY_BY_EDGE

if TYPE_CHECKING:
    from collections.abc import Iterator

_AT_ONCE = 1000
_CAPTURE_RECORD = (
    *("frame", "burst_frame", "burst_size", "timestamp_s", "width_px", "height_px", "fill"),
    *("source", "camera", "provenance", "depth_unit_m", "gravity", "doubts"),
)


def _from_3() -> None:
    """From schema 3 (0.1.0, 9771f34 to 64d81fbb): a fruit is its row, and a decision a mark."""
    for statement in (
        ("DROP TRIGGER actions_no_update", "DROP TRIGGER actions_no_delete")
        if op.get_bind().dialect.name == "sqlite"
        else ("DROP FUNCTION cucumbervision_keep_log() CASCADE",)
    ):
        op.execute(statement)
    _move_marks()
    _move_captures()
    _move_stops()
    _move_shapes()
    with op.batch_alter_table("rounds") as table:
        table.drop_column("sha256")
    op.drop_table("joint_measurements")


def _table(name: str) -> sa.Table:
    return sa.Table(name, sa.MetaData(), autoload_with=op.get_bind())


def _lines(query: Any) -> list[dict[str, Any]]:
    return [dict(line) for line in op.get_bind().execute(query).mappings()]


def _update(table: sa.Table, values: dict[int, dict[str, Any]]) -> None:
    for line_id, cells in values.items():
        op.get_bind().execute(sa.update(table).where(table.c.id == line_id).values(**cells))


def _move_marks() -> None:
    """Make marks of actions, with what stood in old marks and in links that people made."""
    deleted = sa.Column("deleted", sa.Boolean, nullable=False, server_default=sa.false())
    op.add_column("fruit", deleted)
    actions, old, links, fruit = map(_table, ("actions", "marks", "links", "fruit"))
    details: dict[int, dict[str, Any]] = defaultdict(dict)
    gone = []
    for mark in _lines(sa.select(old)):
        if mark["slot"] == "mask":
            details[mark["action_id"]]["row"] = _row_of(mark["details"])
        elif mark["slot"] == "added" and mark["ended_by_id"] is not None:
            gone.append(mark["fruit_id"])
    accepted = {m["action_id"] for m in _lines(sa.select(old)) if m["slot"] == "verdict"}
    key_of = {line["id"]: line["key"] for line in _lines(sa.select(fruit.c.id, fruit.c.key))}
    for link in _lines(sa.select(links).where(links.c.action_id.is_not(None))):
        rounds = {link["first_round_id"], link["second_round_id"]}
        made = details[link["action_id"]]
        made["rounds"] = sorted(rounds.union(made.get("rounds", ())))
        if link["ended_by_id"] is not None:
            pair = [key_of[link["first_id"]], key_of[link["second_id"]]]
            details[link["ended_by_id"]].setdefault("ends", []).append(pair)
    row_of = {line["id"]: line["name"] for line in _lines(sa.select(_table("rows")))}
    lines = []
    for action in _lines(sa.select(actions).order_by(actions.c.id)):
        del action["sha256"]
        action["details"] = {**action["details"], **details.get(action["id"], {})}
        if action["kind"] == "add":
            change: dict[str, Any] = {"table": "fruit", "key": action["fruit"][0]}
            change |= {"before": {"deleted": True}, "after": {"deleted": False}}
            verdict = {"verdict": "accept"} if action["id"] in accepted else {}
            action["details"] |= {**change, **verdict}
        for when in ("before", "after"):
            cells = action["details"].get(when, {})
            if "row_id" in cells:
                cells["row"] = row_of.get(cells.pop("row_id"))
        if action["kind"] in ("merge", "unmerge", "link-growth", "unlink-growth"):
            action["details"].setdefault("rounds", [action["round_id"]])
        lines.append(action)
    op.get_bind().execute(sa.update(fruit).where(fruit.c.id.in_(gone)).values(deleted=True))
    op.get_bind().execute(sa.delete(links).where(links.c.action_id.is_not(None)))
    op.drop_table("marks")
    with op.batch_alter_table("links", recreate="auto") as table:
        for name in ("ix_links_action_id", "ix_links_ended_by_id", "uq_links_active"):
            table.drop_index(name)
        for end in ("action_id", "ended_by_id"):
            table.drop_constraint(f"fk_links_{end}_actions", type_="foreignkey")
            table.drop_column(end)
        table.drop_column("sha256")
    op.drop_table("actions")
    marks = op.create_table(
        "marks",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("at_s", sa.Double, nullable=False),
        sa.Column("by", sa.Text, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("round_id", sa.Integer, sa.ForeignKey("rounds.id"), index=True),
        sa.Column("fruit", sa.JSON, nullable=False),
        sa.Column("details", sa.JSON, nullable=False),
        sa.Column("undoes_id", sa.Integer, sa.ForeignKey("marks.id"), unique=True),
    )
    if lines:
        op.bulk_insert(marks, lines)
    _go_on_counting("marks")


def _go_on_counting(table: str) -> None:
    if op.get_bind().dialect.name == "postgresql":
        newest = f"(SELECT coalesce(max(id), 0) + 1 FROM {table})"
        op.execute(f"SELECT setval(pg_get_serial_sequence('{table}', 'id'), {newest}, false)")


def _row_of(record: dict[str, Any]) -> dict[str, Any]:
    """Return the row of a corrected record: its lengths are columns, and its path one method's."""
    row = {**record, "fruit": record.pop("number")}
    methods = row.pop("methods")
    for before in ("", "raw_"):
        length = row.pop(f"{before}length", None)
        values = tuple(length.values()) if length else (None,) * 6
        names = ("length_m", "length_kind", *(f"interval_{x}" for x in ("low_m", "high_m", "of")))
        names = (*names, "interval_basis")
        row |= {before + name: value for name, value in zip(names, values, strict=True)}
    row |= {f"{m['method'].lower()}_m": m["length_m"] for m in methods}
    chosen: dict[str, Any] = next((m for m in methods if m["method"] == row["method"]), {})
    return row | {name: chosen.get(name, []) for name in ("path_m", "diameter_m")}


def _move_captures() -> None:
    """Name pictures by their files, and put what is no column into one cell."""
    captures, images = _table("captures"), _table("images")
    suffix_of = {image["sha256"]: image["suffix"] for image in _lines(sa.select(images))}
    gravity_of = _gravity_by_stop()
    for name in ("color", "depth", "thumbnail"):
        op.add_column("captures", sa.Column(name, sa.Text))
    op.add_column("captures", sa.Column("record", sa.JSON, nullable=False, server_default="{}"))
    values = {}
    for capture in _lines(sa.select(captures)):
        record = {name: capture.get(name) for name in _CAPTURE_RECORD}
        # Stores of 0.1.0 kept how the camera was held, and not the gravity that follows from it.
        record["gravity"] = record["gravity"] or gravity_of.get(capture["stop_id"])
        digests = {n: capture[f"{n}_sha256"] for n in ("color", "depth", "thumbnail")}
        names = {n: x and f"{x}{suffix_of[x]}" for n, x in digests.items()}
        values[capture["id"]] = {**names, "record": record}
    _update(_table("captures"), values)
    with op.batch_alter_table("captures") as table:
        for name in ("color", "depth", "thumbnail"):
            table.drop_index(f"ix_captures_{name}_sha256")
            table.drop_constraint(f"fk_captures_{name}_sha256_images", type_="foreignkey")
            table.drop_column(f"{name}_sha256")
        for name in set(_CAPTURE_RECORD) & set(captures.c.keys()):
            table.drop_column(name)
        table.alter_column("record", server_default=None)
    for name in ("color", "depth", "thumbnail"):
        op.create_index(f"ix_captures_{name}", "captures", [name])
    op.drop_table("images")


def _artifacts() -> Iterator[tuple[int, dict[str, Any]]]:
    made, of_stop = _table("artifacts"), _table("stop_artifacts")
    query = sa.select(of_stop.c.stop_id, made.c.kind, made.c.name, made.c.sha256, made.c.details)
    query = query.join(made, made.c.id == of_stop.c.artifact_id)
    for line in _lines(query.order_by(of_stop.c.stop_id, of_stop.c.number)):
        yield line.pop("stop_id"), line


def _gravity_by_stop() -> dict[int, Any]:
    edges = {
        k: str(made["details"].get("camera_up"))
        for k, made in _artifacts()
        if made["kind"] == "config"
    }
    return {
        stop: list(GRAVITY_BY_EDGE[edge]) for stop, edge in edges.items() if edge in GRAVITY_BY_EDGE
    }


def _move_stops() -> None:
    """Give a stop its row's name and what it was measured with."""
    artifacts: dict[int, list[dict[str, Any]]] = defaultdict(list)
    for stop_id, made in _artifacts():
        if made["kind"] != "measured-from":
            artifacts[stop_id].append(made)
    op.add_column("stops", sa.Column("row", sa.Text))
    op.add_column("stops", sa.Column("artifacts", sa.JSON, nullable=False, server_default="[]"))
    stops, rows = _table("stops"), _table("rows")
    name = sa.select(rows.c.name).where(rows.c.id == stops.c.row_id).scalar_subquery()
    op.get_bind().execute(sa.update(stops).values(row=name))
    _update(stops, {stop_id: {"artifacts": made} for stop_id, made in artifacts.items()})
    with op.batch_alter_table("stops") as table:
        table.drop_index("ix_stops_row_id")
        table.drop_constraint("fk_stops_row_id_rows", type_="foreignkey")
        for column in ("row_id", "content_sha256", "rows_sha256", "sha256"):
            table.drop_column(column)
        table.alter_column("artifacts", server_default=None)
    for gone in ("stop_artifacts", "artifacts", "rows"):
        op.drop_table(gone)


def _unpacked(data: bytes) -> list[float]:
    """Return metres from little-endian 32-bit micrometres."""
    return [x / 1e6 for (x,) in struct.iter_unpack("<i", data)]


def _move_shapes() -> None:
    """Make columns of the methods' lengths, and shapes of masks and the chosen method's path."""
    op.execute("ALTER TABLE fruit RENAME COLUMN number TO fruit")
    lengths = [f"m{k}_m" for k in range(1, 7)]
    for name in lengths:
        op.add_column("fruit", sa.Column(name, sa.Double))
    shapes = op.create_table(
        "shapes",
        sa.Column("fruit_id", sa.Integer, sa.ForeignKey("fruit.id"), primary_key=True),
        sa.Column("mask", sa.Text),
        sa.Column("record", sa.JSON, nullable=False),
    )
    fruit, masks, methods = map(_table, ("fruit", "masks", "measurements"))
    bind = op.get_bind()
    last = bind.execute(sa.select(sa.func.max(fruit.c.id))).scalar() or 0
    for first in range(0, last + 1, _AT_ONCE):
        within = first, first + _AT_ONCE - 1
        query = sa.select(fruit.c.id, fruit.c.method, masks.c.rle, masks.c.keypoints)
        query = query.join(masks, masks.c.fruit_id == fruit.c.id).where(fruit.c.id.between(*within))
        made: dict[int, list[dict[str, Any]]] = defaultdict(list)
        for method in _lines(sa.select(methods).where(methods.c.fruit_id.between(*within))):
            made[method["fruit_id"]].append(method)
        lines = []
        for line in _lines(query):
            chosen = next((m for m in made[line["id"]] if m["method"] == line["method"]), None)
            path = _unpacked(chosen["path_um"]) if chosen else []
            record = {
                "keypoints": line["keypoints"],
                "path_m": [path[k : k + 3] for k in range(0, len(path), 3)],
                "diameter_m": _unpacked(chosen["diameter_um"]) if chosen else [],
            }
            lines.append({"fruit_id": line["id"], "mask": line["rle"], "record": record})
        if lines:
            op.bulk_insert(shapes, lines)
        _update(
            fruit,
            {
                fruit_id: {f"{m['method'].lower()}_m": m["length_m"] for m in used}
                for fruit_id, used in made.items()
                if any(f"{m['method'].lower()}_m" in lengths for m in used)
            },
        )
    op.drop_table("masks")
    op.drop_table("measurements")


FIRST = 3
"""Version of the stores of 0.1.0, the oldest that are opened."""

STEPS = (_from_3,)
"""From version `FIRST` + n to the next."""
