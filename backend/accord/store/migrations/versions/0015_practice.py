"""Mark gold queries as practice pairs with an explanation, and record who was told the answer of one."""

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("queries", sa.Column("practice", sa.Boolean(), nullable=False, server_default=sa.false()))
    op.add_column("queries", sa.Column("explanation", sa.String(), nullable=False, server_default=""))
    op.add_column("presentations", sa.Column("practised", sa.Boolean(), nullable=False, server_default=sa.false()))


def downgrade() -> None:
    op.drop_column("presentations", "practised")
    for column in ("explanation", "practice"):
        op.drop_column("queries", column)
