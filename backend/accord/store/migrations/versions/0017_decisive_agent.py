"""Add the agent that decided a preference to labels and their history.

Nobody was asked for it before.
"""

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None

INTEGER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    for table in ("labels", "label_revisions"):
        op.add_column(table, sa.Column("decisive_agent", INTEGER, nullable=True))


def downgrade() -> None:
    for table in ("label_revisions", "labels"):
        op.drop_column(table, "decisive_agent")
