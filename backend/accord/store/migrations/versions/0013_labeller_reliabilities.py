"""Store what is estimated of each labeller for a reward version. Earlier versions have no estimates."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    weights = ("accuracy", "left_weight", "equal_weight", "right_weight", "mean_weight")
    op.create_table(
        "labeller_reliabilities",
        sa.Column("reward_version_id", sa.String(length=32), nullable=False),
        sa.Column("user_id", sa.String(length=32), nullable=False),
        sa.Column("labels", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        *(sa.Column(name, sa.Double(), nullable=False) for name in weights),
        sa.ForeignKeyConstraint(
            ["reward_version_id"], ["reward_versions.id"], name="fk_labeller_reliabilities_reward_version_id"
        ),
        sa.ForeignKeyConstraint(["user_id"], ["users.id"], name="fk_labeller_reliabilities_user_id"),
        sa.PrimaryKeyConstraint("reward_version_id", "user_id", name="pk_labeller_reliabilities"),
    )


def downgrade() -> None:
    op.drop_table("labeller_reliabilities")
