"""What several views of a fruit say together has a table."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Make the table; rounds that are there are measured jointly when they are merged again."""
    op.create_table(
        "joint_measurements",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("round_id", sa.Integer(), nullable=False),
        sa.Column("first", sa.Text(), nullable=False),
        sa.Column("views", sa.Integer(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("record", sa.JSON(), nullable=True),
        sa.Column("drawing", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(
            ["round_id"], ["rounds.id"], name="fk_joint_measurements_round_id_rounds"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_joint_measurements"),
        sa.UniqueConstraint("key", name="uq_joint_measurements_key"),
    )
    op.create_index("ix_joint_measurements_round_id", "joint_measurements", ["round_id"])
