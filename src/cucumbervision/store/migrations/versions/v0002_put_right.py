"""Stops and rounds can be deleted, and a stop's side put right."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"

_ADDED = (("rounds", "deleted"), ("stops", "mirrored"), ("stops", "deleted"))


def upgrade() -> None:
    """Add the columns; nothing is deleted so far."""
    for table, name in _ADDED:
        op.add_column(
            table, sa.Column(name, sa.Boolean(), nullable=False, server_default=sa.false())
        )
