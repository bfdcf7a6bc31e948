"""Add when users were seen and removed, the experiments they may see, and invitations."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("users", sa.Column("all_experiments", sa.Boolean(), nullable=False, server_default=sa.true()))
    op.add_column("users", sa.Column("last_seen_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column("users", sa.Column("removed_at", sa.DateTime(timezone=True), nullable=True))
    op.create_table(
        "experiment_access",
        sa.Column("user_id", sa.String(length=32), nullable=False),
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.ForeignKeyConstraint(["user_id"], ["users.id"], name="fk_experiment_access_user_id"),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_experiment_access_experiment_id"),
        sa.PrimaryKeyConstraint("user_id", "experiment_id", name="pk_experiment_access"),
    )
    op.create_index("ix_experiment_access_experiment_id", "experiment_access", ["experiment_id"])
    op.create_table(
        "invitations",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("hash", sa.String(length=64), nullable=False),
        sa.Column("experiment_id", sa.String(length=32), nullable=True),
        sa.Column("max_uses", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("created_by", sa.String(length=100), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("uses", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_invitations_experiment_id"),
        sa.PrimaryKeyConstraint("id", name="pk_invitations"),
        sa.UniqueConstraint("hash", name="uq_invitations_hash"),
    )
    op.create_index("ix_invitations_experiment_id", "invitations", ["experiment_id"])


def downgrade() -> None:
    op.drop_index("ix_invitations_experiment_id", "invitations")
    op.drop_table("invitations")
    op.drop_index("ix_experiment_access_experiment_id", "experiment_access")
    op.drop_table("experiment_access")
    op.drop_column("users", "removed_at")
    op.drop_column("users", "last_seen_at")
    op.drop_column("users", "all_experiments")
