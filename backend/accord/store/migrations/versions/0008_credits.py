"""Add requests for what a reward version learned."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "credits",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.Column("reward_version_id", sa.String(length=32), nullable=False),
        sa.Column("query_id", sa.String(length=32), nullable=True),
        sa.Column("status", sa.String(length=10), nullable=False),
        sa.Column("detail", sa.String(), nullable=False),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_credits_experiment_id"),
        sa.ForeignKeyConstraint(["reward_version_id"], ["reward_versions.id"], name="fk_credits_reward_version_id"),
        sa.ForeignKeyConstraint(["query_id"], ["queries.id"], name="fk_credits_query_id"),
        sa.PrimaryKeyConstraint("id", name="pk_credits"),
        sa.UniqueConstraint("reward_version_id", "query_id", name="uq_credits_reward_version_id_query_id"),
    )
    op.create_index("ix_credits_experiment_id", "credits", ["experiment_id"])
    op.create_index("ix_credits_status", "credits", ["status"])
    op.create_index("ix_credits_query", "credits", ["query_id"])


def downgrade() -> None:
    op.drop_table("credits")
