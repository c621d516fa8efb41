"""Steps from earlier versions of the tables to the newest, by Alembic's operations.

`docs/store.md` has a table of what moved where.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import sqlalchemy as sa
from alembic import op

from cucumbervision.run.options import GRAVITY_BY_EDGE
from cucumbervision_greenhouse.store import schema as tables

_AT_ONCE = 1000  # lines that are held in memory
_CAPTURE_RECORD = (
    *("frame", "burst_frame", "burst_size", "timestamp_s", "width_px", "height_px", "fill"),
    *("source", "camera", "provenance", "depth_unit_m", "gravity", "doubts"),
)
_OLD = (  # in an order in which they can be dropped
    *("joint_measurements", "marks", "links", "actions", "masks", "measurements", "fruit"),
    *("captures", "images", "stop_artifacts", "artifacts", "stops", "rows", "rounds"),
)
_LENGTHS = tuple(f"m{k}_m" for k in range(1, 7))
_INTERVAL = ("low_m", "high_m", "of", "basis")


def _from_3() -> None:
    """From schema 3 (0.1.0, 9771f34 to 64d81fbb): a fruit is its row, and a decision a mark."""
    old = _set_aside()
    tables.METADATA.create_all(op.get_bind(), checkfirst=False)
    stops, fruit, measured, masks = (
        old[name] for name in ("stops", "fruit", "measurements", "masks")
    )
    _copy(tables.ROUNDS, sa.select(old["rounds"]))
    artifacts = _artifacts(old)
    rows = sa.outerjoin(stops, old["rows"], stops.c.row_id == old["rows"].c.id)
    _copy(
        tables.STOPS,
        sa.select(stops, old["rows"].c.name.label("row")).select_from(rows),
        lambda stop: {
            "artifacts": [made for made in artifacts[stop["id"]] if made["kind"] != "measured-from"]
        },
    )
    suffix_of = {line["sha256"]: line["suffix"] for line in _lines(sa.select(old["images"]))}
    _copy(
        tables.CAPTURES,
        sa.select(old["captures"]),
        lambda capture: _capture(capture, suffix_of, artifacts[capture["stop_id"]]),
    )
    added = _lines(sa.select(old["marks"]).where(old["marks"].c.slot == "added"))
    gone = {mark["fruit_id"] for mark in added if mark["ended_by_id"] is not None}
    lengths: dict[int, dict[str, Any]] = defaultdict(lambda: dict.fromkeys(_LENGTHS))
    for line in _lines(sa.select(*measured.c["fruit_id", "method", "length_m"])):
        lengths[line["fruit_id"]][f"{line['method'].lower()}_m"] = line["length_m"]
    _copy(
        tables.FRUIT,
        sa.select(fruit),
        lambda line: {
            **{"fruit": line["number"], "deleted": line["id"] in gone},
            **{name: lengths[line["id"]][name] for name in _LENGTHS},
        },
    )
    chosen = sa.and_(measured.c.fruit_id == fruit.c.id, measured.c.method == fruit.c.method)
    shaped = sa.join(fruit, masks, masks.c.fruit_id == fruit.c.id).outerjoin(measured, chosen)
    columns = (masks.c["fruit_id", "rle", "keypoints"], measured.c["path_um", "diameter_um"])
    _copy(tables.SHAPES, sa.select(*columns[0], *columns[1]).select_from(shaped), _shape)
    _copy_marks(old)
    _copy(tables.LINKS, sa.select(old["links"]).where(old["links"].c.action_id.is_(None)))
    for name in _OLD:
        old[name].drop(op.get_bind())
    if op.get_bind().dialect.name == "postgresql":
        op.execute("DROP SCHEMA old")
        for name, table in tables.METADATA.tables.items():
            if "id" in table.c:  # go on counting
                newest = f"(SELECT coalesce(max(id), 0) + 1 FROM {name})"
                op.execute(
                    f"SELECT setval(pg_get_serial_sequence('{name}', 'id'), {newest}, false)"
                )


def _set_aside() -> dict[str, sa.Table]:
    """Move the old tables to other names, and return them by their own."""
    bind = op.get_bind()
    schema, prefix = (None, "old_")
    if bind.dialect.name == "postgresql":
        schema, prefix = "old", ""
        op.execute("CREATE SCHEMA old")
        op.execute("DROP FUNCTION cucumbervision_keep_log() CASCADE")
        for name in _OLD:
            op.execute(f"ALTER TABLE {name} SET SCHEMA old")
    else:
        for trigger in ("actions_no_update", "actions_no_delete"):
            op.execute(f"DROP TRIGGER {trigger}")
        for name in _OLD:
            for index in sa.inspect(bind).get_indexes(name):
                op.drop_index(str(index["name"]))
            op.rename_table(name, f"old_{name}")
    reflected = sa.MetaData(schema=schema)
    return {name: sa.Table(f"{prefix}{name}", reflected, autoload_with=bind) for name in _OLD}


def _lines(query: Any) -> list[dict[str, Any]]:
    return [dict(line) for line in op.get_bind().execute(query).mappings()]


def _copy(
    table: sa.Table, query: Any, cells: Callable[[Any], dict[str, Any]] = lambda _: {}
) -> None:
    """Copy the lines of a query into the columns of these names, with other cells."""
    names = {column.name for column in query.selected_columns} & set(table.c.keys())
    found = op.get_bind().execute(query, execution_options={"yield_per": _AT_ONCE})
    for part in found.mappings().partitions():
        lines = [{**{name: line[name] for name in names}, **cells(line)} for line in part]
        op.get_bind().execute(sa.insert(table), lines)


def _artifacts(old: dict[str, sa.Table]) -> dict[int, list[dict[str, Any]]]:
    """Return what each stop was measured with."""
    made, of_stop = old["artifacts"], old["stop_artifacts"]
    query = sa.select(of_stop.c.stop_id, *made.c["kind", "name", "sha256", "details"])
    query = query.join(made, made.c.id == of_stop.c.artifact_id)
    artifacts: dict[int, list[dict[str, Any]]] = defaultdict(list)
    for line in _lines(query.order_by(of_stop.c.stop_id, of_stop.c.number)):
        artifacts[line.pop("stop_id")].append(line)
    return artifacts


def _capture(
    capture: Any, suffix_of: dict[str, str], artifacts: list[dict[str, Any]]
) -> dict[str, Any]:
    """Name images by their files, and put what is no column into one cell."""
    record = {name: capture.get(name) for name in _CAPTURE_RECORD}
    for made in artifacts:  # 0.1.0 stored how the camera was held, and no gravity
        edge = str(made["details"].get("camera_up"))
        if made["kind"] == "config" and edge in GRAVITY_BY_EDGE and not record["gravity"]:
            record["gravity"] = list(GRAVITY_BY_EDGE[edge])
    digests = {name: capture[f"{name}_sha256"] for name in ("color", "depth", "thumbnail")}
    return {name: x and f"{x}{suffix_of[x]}" for name, x in digests.items()} | {"record": record}


def _shape(line: Any) -> dict[str, Any]:
    path, diameter = (
        # Little-endian 32-bit micrometres.
        [x / 1e6 for (x,) in struct.iter_unpack("<i", line[name] or b"")]
        for name in ("path_um", "diameter_um")
    )
    path_m = [path[k : k + 3] for k in range(0, len(path), 3)]
    record = {"keypoints": line["keypoints"], "path_m": path_m, "diameter_m": diameter}
    return {"mask": line["rle"], "record": record}


def _copy_marks(old: dict[str, sa.Table]) -> None:
    """Make marks of actions, with what was in old marks and in links that people made."""
    actions, links, fruit = (old[name] for name in ("actions", "links", "fruit"))
    details: dict[int, dict[str, Any]] = defaultdict(dict)
    accepted = set()
    for mark in _lines(sa.select(old["marks"])):
        if mark["slot"] == "mask":
            details[mark["action_id"]]["row"] = _row_of(mark["details"])
        elif mark["slot"] == "verdict":
            accepted.add(mark["action_id"])
    key_of = {line["id"]: line["key"] for line in _lines(sa.select(*fruit.c["id", "key"]))}
    for link in _lines(sa.select(links).where(links.c.action_id.is_not(None))):
        rounds = {link["first_round_id"], link["second_round_id"]}
        made = details[link["action_id"]]
        made["rounds"] = sorted(rounds.union(made.get("rounds", ())))
        if link["ended_by_id"] is not None:
            pair = [key_of[link["first_id"]], key_of[link["second_id"]]]
            details[link["ended_by_id"]].setdefault("ends", []).append(pair)
    row_of = {line["id"]: line["name"] for line in _lines(sa.select(old["rows"]))}

    def cells(action: Any) -> dict[str, Any]:
        known = {**action["details"], **details[action["id"]]}
        if action["kind"] == "add":
            known |= {"table": "fruit", "key": action["fruit"][0]}
            known |= {"before": {"deleted": True}, "after": {"deleted": False}}
            known |= {"verdict": "accept"} if action["id"] in accepted else {}
        for when in ("before", "after"):
            if "row_id" in known.get(when, {}):
                known[when]["row"] = row_of.get(known[when].pop("row_id"))
        if action["kind"] in ("merge", "unmerge", "link-growth", "unlink-growth"):
            known.setdefault("rounds", [action["round_id"]])
        return {"details": known}

    _copy(tables.MARKS, sa.select(actions).order_by(actions.c.id), cells)


def _row_of(record: dict[str, Any]) -> dict[str, Any]:
    """Return the row of a corrected record: its lengths are columns, and its path one method's."""
    row = {**record, "fruit": record["number"]}
    methods = row.pop("methods")
    del row["number"]
    for before in ("", "raw_"):
        length = row.pop(f"{before}length", None)
        values = tuple(length.values()) if length else (None,) * 6
        names = ("length_m", "length_kind", *(f"interval_{part}" for part in _INTERVAL))
        row |= {before + name: value for name, value in zip(names, values, strict=True)}
    row |= {f"{m['method'].lower()}_m": m["length_m"] for m in methods}
    chosen: dict[str, Any] = next((m for m in methods if m["method"] == row["method"]), {})
    return row | {name: chosen.get(name, []) for name in ("path_m", "diameter_m")}


STEPS = {"3": _from_3}
"""From a version of the tables to the newest."""
