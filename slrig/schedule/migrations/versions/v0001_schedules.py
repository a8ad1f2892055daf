"""Schedules and their runs."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Make the two tables."""
    op.create_table(
        "schedule",
        sa.Column("id", sa.String(36), primary_key=True),
        sa.Column("label", sa.String(200)),
        sa.Column("cron", sa.String(200), nullable=False),
        sa.Column("time_zone", sa.String(64), nullable=False),
        sa.Column("task", sa.String(16), nullable=False),
        sa.Column("options", sa.JSON, nullable=False),
        sa.Column("grace_s", sa.Float, nullable=False),
        sa.Column("retry_s", sa.Float, nullable=False),
        sa.Column("catch_up", sa.Boolean, nullable=False),
        sa.Column("enabled", sa.Boolean, nullable=False),
        sa.Column("created_at", sa.String(32), nullable=False),
        sa.Column("next_due", sa.String(32), nullable=False),
    )
    op.create_table(
        "run",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("schedule_id", sa.String(36), sa.ForeignKey("schedule.id", ondelete="CASCADE"), nullable=False),
        sa.Column("due", sa.String(32), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("reason", sa.String),
        sa.Column("count", sa.Integer, nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("deadline", sa.String(32), nullable=False),
        sa.Column("next_attempt", sa.String(32)),
        sa.Column("started_at", sa.String(32)),
        sa.Column("finished_at", sa.String(32)),
        sa.Column("owner", sa.String(36)),
        sa.Column("alive_until", sa.String(32)),
        sa.Column("result", sa.JSON),
        sa.UniqueConstraint("schedule_id", "due", name="uq_run_due"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_run_state", "run", ["state"])


def downgrade() -> None:
    """Drop them."""
    op.drop_index("ix_run_state", "run")
    op.drop_table("run")
    op.drop_table("schedule")
