"""The first tables."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

_ACTIVE = sa.text("ended_by_id IS NULL")
_MEASURED = (
    "length_m",
    "length_sd_m",
    "interval_low_m",
    "interval_high_m",
    "centreline_m",
    "thread_m",
    "chord_m",
    "inner_arc_m",
    "diameter_max_m",
    "diameter_mean_m",
    "volume_m3",
    "tilt_deg",
    "hidden_share",
    "fill",
    "distance_m",
    "raw_length_m",
    "centre_x_m",
    "centre_y_m",
    "centre_z_m",
    "offset_m",
    "offset_sd_m",
)


def upgrade() -> None:
    """Make them all."""
    _rounds()
    _artifacts()
    _stops()
    _captures()
    _fruit()
    _fruit_details()
    _log()
    _links()
    _guard_log()


def _rounds() -> None:
    """Make rounds, rows, and shifts of rows between rounds."""
    op.create_table(
        "rounds",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("house", sa.Text(), nullable=False),
        sa.Column("started_s", sa.Double(), nullable=False),
        sa.Column("profile", sa.Text(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_rounds"),
        sa.UniqueConstraint("key", name="uq_rounds_key"),
    )
    op.create_index("ix_rounds_started_s", "rounds", ["started_s"])
    op.create_table(
        "rows",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("house", sa.Text(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_rows"),
        sa.UniqueConstraint("house", "name", name="uq_rows_house_name"),
    )
    op.create_table(
        "shifts",
        sa.Column("row_id", sa.Integer(), nullable=False),
        sa.Column("earlier_id", sa.Integer(), nullable=False),
        sa.Column("later_id", sa.Integer(), nullable=False),
        sa.Column("shift_m", sa.Double(), nullable=False),
        sa.Column("sd_m", sa.Double(), nullable=True),
        sa.ForeignKeyConstraint(["earlier_id"], ["rounds.id"], name="fk_shifts_earlier_id_rounds"),
        sa.ForeignKeyConstraint(["later_id"], ["rounds.id"], name="fk_shifts_later_id_rounds"),
        sa.ForeignKeyConstraint(["row_id"], ["rows.id"], name="fk_shifts_row_id_rows"),
        sa.PrimaryKeyConstraint("row_id", "earlier_id", "later_id", name="pk_shifts"),
    )


def _artifacts() -> None:
    """Make artifacts and pictures."""
    op.create_table(
        "artifacts",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("sha256", sa.Text(), nullable=False),
        sa.Column("details", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_artifacts"),
        sa.UniqueConstraint("kind", "name", "sha256", name="uq_artifacts_kind_name_sha256"),
    )
    op.create_table(
        "images",
        sa.Column("sha256", sa.Text(), nullable=False),
        sa.Column("suffix", sa.Text(), nullable=False),
        sa.Column("size_bytes", sa.Integer(), nullable=False),
        sa.Column("width_px", sa.Integer(), nullable=False),
        sa.Column("height_px", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("sha256", name="pk_images"),
    )


def _stops() -> None:
    """Make stops."""
    op.create_table(
        "stops",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("content_sha256", sa.Text(), nullable=False),
        sa.Column("round_id", sa.Integer(), nullable=False),
        sa.Column("row_id", sa.Integer(), nullable=True),
        sa.Column("side", sa.Text(), nullable=True),
        sa.Column("position_m", sa.Double(), nullable=True),
        sa.Column("position_sd_m", sa.Double(), nullable=True),
        sa.Column("step", sa.Integer(), nullable=True),
        sa.Column("taken_s", sa.Double(), nullable=False),
        sa.Column("pose", sa.JSON(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("failures", sa.JSON(), nullable=False),
        sa.Column("fitted_m", sa.Double(), nullable=True),
        sa.Column("fitted_sd_m", sa.Double(), nullable=True),
        sa.ForeignKeyConstraint(["round_id"], ["rounds.id"], name="fk_stops_round_id_rounds"),
        sa.ForeignKeyConstraint(["row_id"], ["rows.id"], name="fk_stops_row_id_rows"),
        sa.PrimaryKeyConstraint("id", name="pk_stops"),
        sa.UniqueConstraint("key", name="uq_stops_key"),
    )
    op.create_index("ix_stops_round_id", "stops", ["round_id"])
    op.create_index("ix_stops_row_id", "stops", ["row_id"])
    op.create_table(
        "stop_artifacts",
        sa.Column("stop_id", sa.Integer(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("artifact_id", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["artifact_id"], ["artifacts.id"], name="fk_stop_artifacts_artifact_id_artifacts"
        ),
        sa.ForeignKeyConstraint(["stop_id"], ["stops.id"], name="fk_stop_artifacts_stop_id_stops"),
        sa.PrimaryKeyConstraint("stop_id", "number", name="pk_stop_artifacts"),
    )
    op.create_index("ix_stop_artifacts_artifact_id", "stop_artifacts", ["artifact_id"])


def _captures() -> None:
    """Make captures."""
    op.create_table(
        "captures",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("stop_id", sa.Integer(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("frame", sa.Integer(), nullable=False),
        sa.Column("burst_frame", sa.Integer(), nullable=False),
        sa.Column("burst_size", sa.Integer(), nullable=False),
        sa.Column("timestamp_s", sa.Double(), nullable=True),
        sa.Column("width_px", sa.Integer(), nullable=False),
        sa.Column("height_px", sa.Integer(), nullable=False),
        sa.Column("fill", sa.Double(), nullable=True),
        sa.Column("simulated", sa.Boolean(), nullable=False),
        sa.Column("source", sa.Text(), nullable=False),
        sa.Column("camera", sa.JSON(), nullable=False),
        sa.Column("provenance", sa.JSON(), nullable=False),
        sa.Column("depth_unit_m", sa.Double(), nullable=True),
        sa.Column("color_sha256", sa.Text(), nullable=True),
        sa.Column("depth_sha256", sa.Text(), nullable=True),
        sa.Column("thumbnail_sha256", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(
            ["color_sha256"], ["images.sha256"], name="fk_captures_color_sha256_images"
        ),
        sa.ForeignKeyConstraint(
            ["depth_sha256"], ["images.sha256"], name="fk_captures_depth_sha256_images"
        ),
        sa.ForeignKeyConstraint(["stop_id"], ["stops.id"], name="fk_captures_stop_id_stops"),
        sa.ForeignKeyConstraint(
            ["thumbnail_sha256"], ["images.sha256"], name="fk_captures_thumbnail_sha256_images"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_captures"),
        sa.UniqueConstraint("stop_id", "name", name="uq_captures_stop_id_name"),
        sa.UniqueConstraint("stop_id", "number", name="uq_captures_stop_id_number"),
    )
    op.create_index("ix_captures_color_sha256", "captures", ["color_sha256"])
    op.create_index("ix_captures_depth_sha256", "captures", ["depth_sha256"])
    op.create_index("ix_captures_thumbnail_sha256", "captures", ["thumbnail_sha256"])


def _fruit() -> None:
    """Make fruit, with what lists show."""
    op.create_table(
        "fruit",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("capture_id", sa.Integer(), nullable=False),
        sa.Column("round_id", sa.Integer(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("label", sa.Text(), nullable=False),
        sa.Column("score", sa.Double(), nullable=False),
        sa.Column("box_x1_px", sa.Double(), nullable=False),
        sa.Column("box_y1_px", sa.Double(), nullable=False),
        sa.Column("box_x2_px", sa.Double(), nullable=False),
        sa.Column("box_y2_px", sa.Double(), nullable=False),
        sa.Column("method", sa.Text(), nullable=True),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("fallback", sa.Text(), nullable=False),
        sa.Column("flags", sa.Text(), nullable=False),
        sa.Column("length_kind", sa.Text(), nullable=True),
        sa.Column("interval_of", sa.Text(), nullable=True),
        sa.Column("interval_basis", sa.Text(), nullable=True),
        sa.Column("mask_source", sa.Text(), nullable=True),
        sa.Column("mask_px", sa.Integer(), nullable=True),
        sa.Column("raw_length_kind", sa.Text(), nullable=True),
        sa.Column("view_score", sa.Double(), nullable=False),
        *(sa.Column(name, sa.Double(), nullable=True) for name in _MEASURED),
        sa.ForeignKeyConstraint(
            ["capture_id"], ["captures.id"], name="fk_fruit_capture_id_captures"
        ),
        sa.ForeignKeyConstraint(["round_id"], ["rounds.id"], name="fk_fruit_round_id_rounds"),
        sa.PrimaryKeyConstraint("id", name="pk_fruit"),
        sa.UniqueConstraint("capture_id", "number", name="uq_fruit_capture_id_number"),
        sa.UniqueConstraint("key", name="uq_fruit_key"),
    )
    op.create_index("ix_fruit_round_id", "fruit", ["round_id"])


def _fruit_details() -> None:
    """Make what lists of fruit leave out."""
    op.create_table(
        "masks",
        sa.Column("fruit_id", sa.Integer(), nullable=False),
        sa.Column("rle", sa.Text(), nullable=True),
        sa.Column("keypoints", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["fruit_id"], ["fruit.id"], name="fk_masks_fruit_id_fruit"),
        sa.PrimaryKeyConstraint("fruit_id", name="pk_masks"),
    )
    op.create_table(
        "measurements",
        sa.Column("fruit_id", sa.Integer(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("method", sa.Text(), nullable=False),
        sa.Column("length_m", sa.Double(), nullable=True),
        sa.Column("kind", sa.Text(), nullable=True),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("fallback", sa.Text(), nullable=False),
        sa.Column("measured_by", sa.Text(), nullable=True),
        sa.Column("centreline_m", sa.Double(), nullable=True),
        sa.Column("thread_m", sa.Double(), nullable=True),
        sa.Column("chord_m", sa.Double(), nullable=True),
        sa.Column("centreline_sd_m", sa.Double(), nullable=True),
        sa.Column("thread_sd_m", sa.Double(), nullable=True),
        sa.Column("path_um", sa.LargeBinary(), nullable=False),
        sa.Column("diameter_um", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["fruit_id"], ["fruit.id"], name="fk_measurements_fruit_id_fruit"),
        sa.PrimaryKeyConstraint("fruit_id", "number", name="pk_measurements"),
    )


def _log() -> None:
    """Make the log and the marks."""
    op.create_table(
        "actions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("at_s", sa.Double(), nullable=False),
        sa.Column("by", sa.Text(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("round_id", sa.Integer(), nullable=True),
        sa.Column("fruit", sa.JSON(), nullable=False),
        sa.Column("details", sa.JSON(), nullable=False),
        sa.Column("undoes_id", sa.Integer(), nullable=True),
        sa.ForeignKeyConstraint(["round_id"], ["rounds.id"], name="fk_actions_round_id_rounds"),
        sa.ForeignKeyConstraint(["undoes_id"], ["actions.id"], name="fk_actions_undoes_id_actions"),
        sa.PrimaryKeyConstraint("id", name="pk_actions"),
        sa.UniqueConstraint("undoes_id", name="uq_actions_undoes_id"),
    )
    op.create_index("ix_actions_round_id", "actions", ["round_id"])
    op.create_table(
        "marks",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("fruit_id", sa.Integer(), nullable=False),
        sa.Column("slot", sa.Text(), nullable=False),
        sa.Column("value", sa.Text(), nullable=False),
        sa.Column("details", sa.JSON(), nullable=False),
        sa.Column("action_id", sa.Integer(), nullable=False),
        sa.Column("ended_by_id", sa.Integer(), nullable=True),
        sa.ForeignKeyConstraint(["action_id"], ["actions.id"], name="fk_marks_action_id_actions"),
        sa.ForeignKeyConstraint(
            ["ended_by_id"], ["actions.id"], name="fk_marks_ended_by_id_actions"
        ),
        sa.ForeignKeyConstraint(["fruit_id"], ["fruit.id"], name="fk_marks_fruit_id_fruit"),
        sa.PrimaryKeyConstraint("id", name="pk_marks"),
    )
    op.create_index("ix_marks_action_id", "marks", ["action_id"])
    op.create_index("ix_marks_ended_by_id", "marks", ["ended_by_id"])
    op.create_index("ix_marks_fruit_id", "marks", ["fruit_id"])
    op.create_index(
        "uq_marks_active",
        "marks",
        ["fruit_id", "slot"],
        unique=True,
        sqlite_where=_ACTIVE,
        postgresql_where=_ACTIVE,
    )


def _links() -> None:
    """Make links between fruit."""
    op.create_table(
        "links",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("first_id", sa.Integer(), nullable=False),
        sa.Column("second_id", sa.Integer(), nullable=False),
        sa.Column("first_round_id", sa.Integer(), nullable=False),
        sa.Column("second_round_id", sa.Integer(), nullable=False),
        sa.Column("score", sa.Double(), nullable=True),
        sa.Column("action_id", sa.Integer(), nullable=True),
        sa.Column("ended_by_id", sa.Integer(), nullable=True),
        sa.CheckConstraint("first_id <> second_id", name="ck_links_two"),
        sa.ForeignKeyConstraint(["action_id"], ["actions.id"], name="fk_links_action_id_actions"),
        sa.ForeignKeyConstraint(
            ["ended_by_id"], ["actions.id"], name="fk_links_ended_by_id_actions"
        ),
        sa.ForeignKeyConstraint(["first_id"], ["fruit.id"], name="fk_links_first_id_fruit"),
        sa.ForeignKeyConstraint(
            ["first_round_id"], ["rounds.id"], name="fk_links_first_round_id_rounds"
        ),
        sa.ForeignKeyConstraint(["second_id"], ["fruit.id"], name="fk_links_second_id_fruit"),
        sa.ForeignKeyConstraint(
            ["second_round_id"], ["rounds.id"], name="fk_links_second_round_id_rounds"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_links"),
    )
    op.create_index("ix_links_action_id", "links", ["action_id"])
    op.create_index("ix_links_ended_by_id", "links", ["ended_by_id"])
    op.create_index("ix_links_first_round_id", "links", ["first_round_id"])
    op.create_index("ix_links_second_id", "links", ["second_id"])
    op.create_index("ix_links_second_round_id", "links", ["second_round_id"])
    op.create_index(
        "uq_links_active",
        "links",
        ["first_id", "second_id"],
        unique=True,
        sqlite_where=_ACTIVE,
        postgresql_where=_ACTIVE,
    )


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
