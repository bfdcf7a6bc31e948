"""Index the reward versions of metrics: without it, deleting a reward version searches all points of all curves."""

from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_index("ix_metrics_reward_version", "metrics", ["reward_version_id"])


def downgrade() -> None:
    op.drop_index("ix_metrics_reward_version", table_name="metrics")
