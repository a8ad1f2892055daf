"""Verifications of a calibration."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Make the table."""
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
        sa.Column("look", sa.JSON, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_verification_calibration", "verification", ["calibration", "number"])
    op.create_index("ix_verification_at", "verification", ["at"])


def downgrade() -> None:
    """Drop it."""
    op.drop_index("ix_verification_at", "verification")
    op.drop_index("ix_verification_calibration", "verification")
    op.drop_table("verification")
