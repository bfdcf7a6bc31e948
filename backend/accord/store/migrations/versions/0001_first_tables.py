"""First tables."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

INTEGER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "claims",
        sa.Column("subject", sa.String(length=80), nullable=False),
        sa.Column("holder", sa.String(length=64), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("subject", name="pk_claims"),
    )
    op.create_table(
        "users",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("role", sa.String(length=20), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_users"),
        sa.UniqueConstraint("name", name="uq_users_name"),
    )
    op.create_table(
        "workers",
        sa.Column("id", sa.String(length=64), nullable=False),
        sa.Column("role", sa.String(length=10), nullable=False),
        sa.Column("pid", INTEGER, nullable=False),
        sa.Column("state", sa.String(length=20), nullable=False),
        sa.Column("detail", sa.String(), nullable=False),
        sa.Column("restarts", INTEGER, nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("heartbeat_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_workers"),
    )
    op.create_table(
        "experiments",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("config", sa.JSON(), nullable=False),
        sa.Column("instructions", sa.String(), nullable=False),
        sa.Column("owner_id", sa.String(length=32), nullable=False),
        sa.Column("status", sa.String(length=20), nullable=False),
        sa.Column("phase", sa.String(length=30), nullable=False),
        sa.Column("phase_detail", sa.String(), nullable=False),
        sa.Column("steps", INTEGER, nullable=False),
        sa.Column("label_revision", INTEGER, nullable=False),
        sa.Column("label_count", INTEGER, nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["owner_id"], ["users.id"], name="fk_experiments_owner_id"),
        sa.PrimaryKeyConstraint("id", name="pk_experiments"),
        sa.UniqueConstraint("name", name="uq_experiments_name"),
    )
    op.create_index("ix_experiments_status", "experiments", ["status"], unique=False)

    op.create_table(
        "tokens",
        sa.Column("hash", sa.String(length=64), nullable=False),
        sa.Column("user_id", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=10), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("used_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["user_id"], ["users.id"], name="fk_tokens_user_id"),
        sa.PrimaryKeyConstraint("hash", name="pk_tokens"),
    )
    op.create_index("ix_tokens_user_id", "tokens", ["user_id"], unique=False)

    op.create_table(
        "reward_versions",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.Column("number", INTEGER, nullable=False),
        sa.Column("parent_id", sa.String(length=32), nullable=True),
        sa.Column("label_watermark", INTEGER, nullable=False),
        sa.Column("label_count", INTEGER, nullable=False),
        sa.Column("policy_steps", INTEGER, nullable=False),
        sa.Column("blob_key", sa.String(), nullable=False),
        sa.Column("metrics", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_reward_versions_experiment_id"),
        sa.ForeignKeyConstraint(["parent_id"], ["reward_versions.id"], name="fk_reward_versions_parent_id"),
        sa.PrimaryKeyConstraint("id", name="pk_reward_versions"),
        sa.UniqueConstraint("experiment_id", "number", name="uq_reward_versions_experiment_id_number"),
    )
    op.create_table(
        "segments",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.Column("policy_iteration", INTEGER, nullable=False),
        sa.Column("policy_steps", INTEGER, nullable=False),
        sa.Column("blob_key", sa.String(), nullable=False),
        sa.Column("length_steps", INTEGER, nullable=False),
        sa.Column("true_return", sa.Double(), nullable=False),
        sa.Column("mujoco_version", sa.String(length=20), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_segments_experiment_id"),
        sa.PrimaryKeyConstraint("id", name="pk_segments"),
    )
    op.create_index("ix_segments_newest", "segments", ["experiment_id", "policy_steps"], unique=False)

    op.create_table(
        "clips",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.Column("segment_id", sa.String(length=32), nullable=False),
        sa.Column("cache_key", sa.String(length=64), nullable=True),
        sa.Column("blob_key", sa.String(), nullable=True),
        sa.Column("status", sa.String(length=10), nullable=False),
        sa.Column("attempts", INTEGER, nullable=False),
        sa.Column("detail", sa.String(), nullable=False),
        sa.Column("size_bytes", INTEGER, nullable=False),
        sa.Column("frames", INTEGER, nullable=False),
        sa.Column("seconds", sa.Double(), nullable=False),
        sa.Column("width", INTEGER, nullable=False),
        sa.Column("height", INTEGER, nullable=False),
        sa.Column("claimed_by", sa.String(length=64), nullable=True),
        sa.Column("claimed_until", sa.DateTime(timezone=True), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_clips_experiment_id"),
        sa.ForeignKeyConstraint(["segment_id"], ["segments.id"], name="fk_clips_segment_id"),
        sa.PrimaryKeyConstraint("id", name="pk_clips"),
        sa.UniqueConstraint("segment_id", name="uq_clips_segment_id"),
    )
    op.create_index("ix_clips_experiment_id", "clips", ["experiment_id"], unique=False)
    op.create_index("ix_clips_status", "clips", ["status"], unique=False)

    op.create_table(
        "metrics",
        sa.Column("id", INTEGER, autoincrement=True, nullable=False),
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=60), nullable=False),
        sa.Column("step", INTEGER, nullable=False),
        sa.Column("value", sa.Double(), nullable=False),
        sa.Column("reward_version_id", sa.String(length=32), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_metrics_experiment_id"),
        sa.ForeignKeyConstraint(["reward_version_id"], ["reward_versions.id"], name="fk_metrics_reward_version_id"),
        sa.PrimaryKeyConstraint("id", name="pk_metrics"),
        sa.UniqueConstraint("experiment_id", "name", "step", name="uq_metrics_experiment_id_name_step"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_metrics_newer", "metrics", ["experiment_id", "id"], unique=False)

    op.create_table(
        "policy_checkpoints",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.Column("steps", INTEGER, nullable=False),
        sa.Column("iteration", INTEGER, nullable=False),
        sa.Column("blob_key", sa.String(), nullable=False),
        sa.Column("reward_version_id", sa.String(length=32), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_policy_checkpoints_experiment_id"),
        sa.ForeignKeyConstraint(
            ["reward_version_id"], ["reward_versions.id"], name="fk_policy_checkpoints_reward_version_id"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_policy_checkpoints"),
    )
    op.create_index("ix_policy_checkpoints_experiment_id", "policy_checkpoints", ["experiment_id"], unique=False)

    op.create_table(
        "queries",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.Column("segment_0_id", sa.String(length=32), nullable=False),
        sa.Column("segment_1_id", sa.String(length=32), nullable=False),
        sa.Column("number", INTEGER, nullable=False),
        sa.Column("status", sa.String(length=10), nullable=False),
        sa.Column("selector", sa.String(length=40), nullable=False),
        sa.Column("reward_version_id", sa.String(length=32), nullable=True),
        sa.Column("leased_by", sa.String(length=32), nullable=True),
        sa.Column("leased_until", sa.DateTime(timezone=True), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_queries_experiment_id"),
        sa.ForeignKeyConstraint(["leased_by"], ["users.id"], name="fk_queries_leased_by"),
        sa.ForeignKeyConstraint(["reward_version_id"], ["reward_versions.id"], name="fk_queries_reward_version_id"),
        sa.ForeignKeyConstraint(["segment_0_id"], ["segments.id"], name="fk_queries_segment_0_id"),
        sa.ForeignKeyConstraint(["segment_1_id"], ["segments.id"], name="fk_queries_segment_1_id"),
        sa.PrimaryKeyConstraint("id", name="pk_queries"),
        sa.UniqueConstraint("experiment_id", "number", name="uq_queries_experiment_id_number"),
        sa.UniqueConstraint(
            "experiment_id", "segment_0_id", "segment_1_id", name="uq_queries_experiment_id_segment_0_id_segment_1_id"
        ),
    )
    op.create_index("ix_queries_leased", "queries", ["leased_by", "experiment_id", "number"], unique=False)
    op.create_index("ix_queries_offered", "queries", ["experiment_id", "status", "number"], unique=False)
    op.create_index("ix_queries_segment_1", "queries", ["segment_1_id"], unique=False)

    op.create_table(
        "labels",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.Column("query_id", sa.String(length=32), nullable=False),
        sa.Column("user_id", sa.String(length=32), nullable=False),
        sa.Column("value", sa.Double(), nullable=True),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("revision", INTEGER, nullable=False),
        sa.Column("left_segment", INTEGER, nullable=True),
        sa.Column("response_seconds", sa.Double(), nullable=True),
        sa.Column("teacher", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_labels_experiment_id"),
        sa.ForeignKeyConstraint(["query_id"], ["queries.id"], name="fk_labels_query_id"),
        sa.ForeignKeyConstraint(["user_id"], ["users.id"], name="fk_labels_user_id"),
        sa.PrimaryKeyConstraint("id", name="pk_labels"),
        sa.UniqueConstraint("experiment_id", "revision", name="uq_labels_experiment_id_revision"),
        sa.UniqueConstraint("query_id", "user_id", name="uq_labels_query_id_user_id"),
    )
    op.create_table(
        "presentations",
        sa.Column("query_id", sa.String(length=32), nullable=False),
        sa.Column("user_id", sa.String(length=32), nullable=False),
        sa.Column("left_segment", INTEGER, nullable=False),
        sa.Column("shown_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["query_id"], ["queries.id"], name="fk_presentations_query_id"),
        sa.ForeignKeyConstraint(["user_id"], ["users.id"], name="fk_presentations_user_id"),
        sa.PrimaryKeyConstraint("query_id", "user_id", name="pk_presentations"),
    )
    op.create_table(
        "label_revisions",
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.Column("revision", INTEGER, nullable=False),
        sa.Column("label_id", sa.String(length=32), nullable=False),
        sa.Column("value", sa.Double(), nullable=True),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("left_segment", INTEGER, nullable=True),
        sa.Column("response_seconds", sa.Double(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_label_revisions_experiment_id"),
        sa.ForeignKeyConstraint(["label_id"], ["labels.id"], name="fk_label_revisions_label_id"),
        sa.PrimaryKeyConstraint("experiment_id", "revision", name="pk_label_revisions"),
    )
    op.create_index("ix_label_revisions_label_id", "label_revisions", ["label_id"], unique=False)


def downgrade() -> None:
    op.drop_table("label_revisions")
    op.drop_table("presentations")
    op.drop_table("labels")
    op.drop_table("queries")
    op.drop_table("policy_checkpoints")
    op.drop_table("metrics")
    op.drop_table("clips")
    op.drop_table("segments")
    op.drop_table("reward_versions")
    op.drop_table("tokens")
    op.drop_table("experiments")
    op.drop_table("workers")
    op.drop_table("users")
    op.drop_table("claims")
