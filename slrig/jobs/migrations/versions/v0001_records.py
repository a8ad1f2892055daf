"""Jobs with their events and idempotency keys, schedules with their runs, and the history of a rig's health."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

# Databases from before there was one chain call their first state 0001.
revision = "records2"
down_revision = None


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "job",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("id", sa.String(36), nullable=False, unique=True),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("parent", sa.String(36)),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("label", sa.String(200)),
        sa.Column("rig", sa.String(200), nullable=False),
        sa.Column("plan", sa.JSON, nullable=False),
        sa.Column("created_at", sa.String(32), nullable=False),
        sa.Column("started_at", sa.String(32)),
        sa.Column("finished_at", sa.String(32)),
        sa.Column("stage", sa.String(64), nullable=False),
        sa.Column("fraction", sa.Float, nullable=False),
        sa.Column("detail", sa.String, nullable=False),
        sa.Column("failure_code", sa.String(64)),
        sa.Column("failure_message", sa.String),
        sa.Column("summary", sa.JSON),
        sa.Column("last_event", sa.Integer, nullable=False),
        sa.Column("pinned", sa.Boolean, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_job_kind_state", "job", ["kind", "state"])
    op.create_index("ix_job_parent", "job", ["parent"])
    op.create_table(
        "event",
        sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("job_id", sa.String(36), sa.ForeignKey("job.id", ondelete="CASCADE"), nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("data", sa.JSON, nullable=False),
        sa.UniqueConstraint("job_id", "number", name="uq_event_number"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "idempotency_key",
        sa.Column("key", sa.String(400), primary_key=True),
        sa.Column("fingerprint", sa.String(64), nullable=False),
        sa.Column("job_id", sa.String(36)),
        sa.Column("created_at", sa.String(32), nullable=False),
    )
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
    op.create_table(
        "verification",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("id", sa.String(36), nullable=False, unique=True),
        sa.Column("at", sa.String(32), nullable=False),
        sa.Column("calibration", sa.String(80), nullable=False),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("reasons", sa.JSON, nullable=False),
        sa.Column("remedy", sa.String),
        sa.Column("found", sa.JSON, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_verification_calibration", "verification", ["calibration", "number"])
    op.create_index("ix_verification_at", "verification", ["at"])


def downgrade() -> None:
    """Drop them."""
    for table in ("verification", "run", "schedule", "idempotency_key", "event", "job"):
        op.drop_table(table)
