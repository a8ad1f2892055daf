"""Rigs, and the jobs that ended there."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "catalogue1"
down_revision = None

_MOMENT = sa.DateTime(timezone=True)
_NUMBER = sa.BigInteger().with_variant(sa.Integer, "sqlite")


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "rig",
        sa.Column("name", sa.String, primary_key=True),
        sa.Column("origin", sa.String, nullable=False),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("version", sa.String, nullable=False),
        sa.Column("started_at", _MOMENT, nullable=False),
        sa.Column("seen_at", _MOMENT, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("words", sa.String, nullable=False),
        sa.Column("waiting", sa.Integer, nullable=False),
        sa.Column("computing", sa.Integer, nullable=False),
        sa.Column("uncopied", sa.Integer, nullable=False),
        sa.Column("health", sa.String, nullable=False),
        sa.Column("health_message", sa.String, nullable=False),
        sa.Column("verified_at", _MOMENT),
    )
    op.create_table(
        "finished_job",
        sa.Column("number", _NUMBER, sa.Identity(), primary_key=True),
        sa.Column("job", sa.String, nullable=False, unique=True),
        sa.Column("rig", sa.String, nullable=False),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("label", sa.String),
        sa.Column("parent", sa.String),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("requested_by", sa.String),
        sa.Column("created_at", _MOMENT, nullable=False),
        sa.Column("started_at", _MOMENT),
        sa.Column("finished_at", _MOMENT, nullable=False),
        sa.Column("fault_code", sa.String),
        sa.Column("fault_message", sa.String),
        sa.Column("points", sa.BigInteger),
        sa.Column("triangles", sa.BigInteger),
        sa.Column("sigma_mm", sa.Float),
        sa.Column("computed_where", sa.String),
        sa.Column("computed_host", sa.String),
    )
    op.create_index("ix_finished_job_rig", "finished_job", ["rig", "kind", "number"])
    op.create_index("ix_finished_job_finished", "finished_job", ["kind", "finished_at"])


def downgrade() -> None:
    """Drop them."""
    op.drop_table("finished_job")
    op.drop_table("rig")
