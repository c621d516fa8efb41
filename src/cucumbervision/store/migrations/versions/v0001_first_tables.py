"""The first tables. A published revision: what a new version needs is a revision of its own."""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

_TYPES = {
    "int": sa.Integer,
    "text": sa.Text,
    "double": sa.Double,
    "bool": sa.Boolean,
    "json": sa.JSON,
    "bytes": sa.LargeBinary,
}
_NAMES = {
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "ck": "ck_%(table_name)s_%(constraint_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
    "pk": "pk_%(table_name)s",
}
# Of each table the columns by type ('?': may be empty), and what each refers to ('id' of a table,
# or that column); an index for a column with '*'.
_COLUMNS = {
    "rounds": "int: id; text: key name house profile note; double: started_s*",
    "rows": "int: id; text: house name",
    "shifts": "int: row_id>rows earlier_id>rounds later_id>rounds; double: shift_m sd_m?",
    "artifacts": "int: id; text: kind name sha256; json: details",
    "images": "text: sha256 suffix; int: size_bytes width_px height_px",
    "stops": """
        int: id round_id*>rounds row_id*?>rows step?; text: key content_sha256 side? note;
        double: position_m? position_sd_m? taken_s fitted_m? fitted_sd_m?; json: pose failures""",
    "stop_artifacts": "int: stop_id>stops number artifact_id*>artifacts",
    "captures": """
        int: id stop_id>stops number frame burst_frame burst_size width_px height_px;
        text: name source color_sha256*?>images.sha256 depth_sha256*?>images.sha256
        thumbnail_sha256*?>images.sha256; double: timestamp_s? fill? depth_unit_m?;
        bool: simulated; json: camera provenance""",
    "fruit": """
        int: id capture_id>captures round_id*>rounds number mask_px?;
        text: key label method? reason fallback flags length_kind? interval_of? interval_basis?
        mask_source? raw_length_kind?;
        double: score box_x1_px box_y1_px box_x2_px box_y2_px view_score length_m? length_sd_m?
        interval_low_m? interval_high_m? centreline_m? thread_m? chord_m? inner_arc_m?
        diameter_max_m? diameter_mean_m? volume_m3? tilt_deg? hidden_share? fill? distance_m?
        raw_length_m? centre_x_m? centre_y_m? centre_z_m? offset_m? offset_sd_m?""",
    "masks": "int: fruit_id>fruit; text: rle?; json: keypoints",
    "measurements": """
        int: fruit_id>fruit number; text: method kind? reason fallback measured_by?;
        double: length_m? centreline_m? thread_m? chord_m? centreline_sd_m? thread_sd_m?;
        bytes: path_um diameter_um""",
    "actions": """
        int: id round_id*?>rounds undoes_id?>actions; double: at_s; text: by kind;
        json: fruit details""",
    "marks": """
        int: id fruit_id*>fruit action_id*>actions ended_by_id*?>actions; text: slot value;
        json: details""",
    "links": """
        int: id first_id>fruit second_id*>fruit first_round_id*>rounds second_round_id*>rounds
        action_id*?>actions ended_by_id*?>actions; text: kind; double: score?""",
}
_KEYS = {
    "shifts": ("row_id", "earlier_id", "later_id"),
    "images": ("sha256",),
    "stop_artifacts": ("stop_id", "number"),
    "masks": ("fruit_id",),
    "measurements": ("fruit_id", "number"),
}
_UNIQUE: dict[str, list[tuple[str, ...]]] = {
    "rounds": [("key",)],
    "rows": [("house", "name")],
    "artifacts": [("kind", "name", "sha256")],
    "stops": [("key",)],
    "captures": [("stop_id", "name"), ("stop_id", "number")],
    "fruit": [("capture_id", "number"), ("key",)],
    "actions": [("undoes_id",)],
}
# One line that has not ended for each of these.
_ACTIVE = {"marks": ("fruit_id", "slot"), "links": ("first_id", "second_id")}


def upgrade() -> None:
    """Make them all."""
    metadata = sa.MetaData(naming_convention=_NAMES)
    for name, text in _COLUMNS.items():
        keys = _KEYS.get(name, ("id",))
        table = sa.Table(name, metadata, *_columns(text, keys))
        for columns in _UNIQUE.get(name, []):
            table.append_constraint(sa.UniqueConstraint(*columns))
        if name in _ACTIVE:
            where = sa.text("ended_by_id IS NULL")
            sa.Index(
                f"uq_{name}_active",
                *(table.c[column] for column in _ACTIVE[name]),
                unique=True,
                sqlite_where=where,
                postgresql_where=where,
            )
    different = sa.CheckConstraint("first_id <> second_id", name="ck_links_two")
    metadata.tables["links"].append_constraint(different)
    metadata.create_all(op.get_bind(), checkfirst=False)
    _guard_log()


def _columns(text: str, keys: tuple[str, ...]) -> list[sa.Column[Any]]:
    found = []
    for part in text.split(";"):
        kind, names = part.split(":")
        for entry in names.split():
            left, _, target = entry.partition(">")
            target = target if not target or "." in target else f"{target}.id"
            name = left.rstrip("*?")
            found.append(
                sa.Column(
                    name,
                    _TYPES[kind.strip()](),
                    *([sa.ForeignKey(target)] if target else []),
                    primary_key=name in keys,
                    nullable="?" in left,
                    index="*" in left or None,
                )
            )
    return sorted(found, key=lambda one: one.name not in keys)


def _guard_log() -> None:
    """Let the database itself keep the log's lines from being changed or removed."""
    if op.get_bind().dialect.name == "sqlite":
        for what in ("UPDATE", "DELETE"):
            op.execute(
                f"CREATE TRIGGER actions_no_{what.lower()} BEFORE {what} ON actions "
                "BEGIN SELECT RAISE(ABORT, 'the log is only added to'); END"
            )
        return
    op.execute(
        "CREATE FUNCTION cucumbervision_keep_log() RETURNS trigger LANGUAGE plpgsql AS "
        "$$ BEGIN RAISE EXCEPTION 'the log is only added to'; END $$"
    )
    op.execute(
        "CREATE TRIGGER actions_keep BEFORE UPDATE OR DELETE ON actions "
        "FOR EACH ROW EXECUTE FUNCTION cucumbervision_keep_log()"
    )
