"""Add clips from other cameras."""

import sqlalchemy as sa
from alembic import op

INTEGER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "clip_views",
        sa.Column("clip_id", sa.String(32), nullable=False),
        sa.Column("camera", sa.String(10), nullable=False),
        sa.Column("experiment_id", sa.String(32), nullable=False),
        sa.Column("status", sa.String(10), nullable=False),
        sa.Column("attempts", INTEGER, nullable=False),
        sa.Column("blob_key", sa.String(), nullable=True),
        sa.Column("size_bytes", INTEGER, nullable=False),
        sa.Column("claimed_by", sa.String(64), nullable=True),
        sa.Column("claimed_until", sa.DateTime(timezone=True), nullable=True),
        sa.Column("requested_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["clip_id"], ["clips.id"], name="fk_clip_views_clip_id"),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_clip_views_experiment_id"),
        sa.PrimaryKeyConstraint("clip_id", "camera", name="pk_clip_views"),
    )
    op.create_index("ix_clip_views_experiment_id", "clip_views", ["experiment_id"])
    op.create_index("ix_clip_views_status", "clip_views", ["status"])


def downgrade() -> None:
    op.drop_table("clip_views")
