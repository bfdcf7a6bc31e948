"""Add recordings of policies, and their videos."""

import sqlalchemy as sa
from alembic import op

INTEGER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "recordings",
        sa.Column("id", sa.String(32), nullable=False),
        sa.Column("experiment_id", sa.String(32), nullable=False),
        sa.Column("policy_steps", INTEGER, nullable=False),
        sa.Column("reward_version_id", sa.String(32), nullable=True),
        sa.Column("length_steps", INTEGER, nullable=False),
        sa.Column("true_return", sa.Double(), nullable=False),
        sa.Column("blob_key", sa.String(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_recordings_experiment_id"),
        sa.ForeignKeyConstraint(["reward_version_id"], ["reward_versions.id"], name="fk_recordings_reward_version_id"),
        sa.PrimaryKeyConstraint("id", name="pk_recordings"),
        sa.UniqueConstraint("experiment_id", "policy_steps", name="uq_recordings_experiment_id_policy_steps"),
    )
    op.create_table(
        "recording_views",
        sa.Column("recording_id", sa.String(32), nullable=False),
        sa.Column("camera", sa.String(10), nullable=False),
        sa.Column("experiment_id", sa.String(32), nullable=False),
        sa.Column("status", sa.String(10), nullable=False),
        sa.Column("attempts", INTEGER, nullable=False),
        sa.Column("blob_key", sa.String(), nullable=True),
        sa.Column("size_bytes", INTEGER, nullable=False),
        sa.Column("claimed_by", sa.String(64), nullable=True),
        sa.Column("claimed_until", sa.DateTime(timezone=True), nullable=True),
        sa.Column("requested_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["recording_id"], ["recordings.id"], name="fk_recording_views_recording_id"),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_recording_views_experiment_id"),
        sa.PrimaryKeyConstraint("recording_id", "camera", name="pk_recording_views"),
    )
    op.create_index("ix_recording_views_experiment_id", "recording_views", ["experiment_id"])
    op.create_index("ix_recording_views_status", "recording_views", ["status"])


def downgrade() -> None:
    op.drop_table("recording_views")
    op.drop_table("recordings")
