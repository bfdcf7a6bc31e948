"""Keep every revision of an experiment's instructions, and which one a label was given under.

The current instructions become revision 1. Under which ones earlier labels were given is not known.
"""

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

INTEGER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "instruction_revisions",
        sa.Column("experiment_id", sa.String(length=32), nullable=False),
        sa.Column("number", INTEGER, nullable=False),
        sa.Column("text", sa.String(), nullable=False),
        sa.Column("author", sa.String(length=100), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name="fk_instruction_revisions_experiment_id"),
        sa.PrimaryKeyConstraint("experiment_id", "number", name="pk_instruction_revisions"),
    )
    op.add_column("experiments", sa.Column("instructions_revision", INTEGER, nullable=False, server_default="1"))
    for table in ("labels", "label_revisions"):
        op.add_column(table, sa.Column("instructions_revision", INTEGER, nullable=True))
    op.execute(
        "INSERT INTO instruction_revisions (experiment_id, number, text, author, created_at) "
        "SELECT id, 1, instructions, '', created_at FROM experiments"
    )


def downgrade() -> None:
    for table in ("label_revisions", "labels"):
        op.drop_column(table, "instructions_revision")
    op.drop_column("experiments", "instructions_revision")
    op.drop_table("instruction_revisions")
