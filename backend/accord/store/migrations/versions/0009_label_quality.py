"""Add several labels per query, repeats, gold queries, final decisions, and the exclusion of labels and labellers.

Earlier queries want one label, and no label is excluded, so that experiments go on as before.
"""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

INTEGER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.add_column("queries", sa.Column("labels_wanted", INTEGER, nullable=False, server_default="1"))
    op.add_column("queries", sa.Column("repeats_id", sa.String(32), nullable=True))
    op.add_column("queries", sa.Column("gold_value", sa.Double(), nullable=True))
    op.create_index("ix_queries_repeats", "queries", ["repeats_id"])
    op.create_index("ix_queries_gold", "queries", ["experiment_id", "gold_value"])
    op.add_column("labels", sa.Column("excluded", sa.Boolean(), nullable=False, server_default=sa.false()))
    op.add_column("labels", sa.Column("exclusion_revision", INTEGER, nullable=True))
    op.add_column("labels", sa.Column("final", sa.Boolean(), nullable=False, server_default=sa.false()))
    op.create_table(
        "labellers",
        sa.Column("experiment_id", sa.String(32), nullable=False),
        sa.Column("user_id", sa.String(32), nullable=False),
        sa.Column("paused_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("excluded_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_labellers_experiment_id"),
        sa.ForeignKeyConstraint(["user_id"], ["users.id"], name="fk_labellers_user_id"),
        sa.PrimaryKeyConstraint("experiment_id", "user_id", name="pk_labellers"),
    )


def downgrade() -> None:
    op.drop_table("labellers")
    for column in ("final", "exclusion_revision", "excluded"):
        op.drop_column("labels", column)
    op.drop_index("ix_queries_gold", "queries")
    op.drop_index("ix_queries_repeats", "queries")
    for column in ("gold_value", "repeats_id", "labels_wanted"):
        op.drop_column("queries", column)
