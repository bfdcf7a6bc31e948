"""Add the tab that holds a lease, so that two tabs of one user lease different queries."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("queries", sa.Column("leased_tab", sa.String(40), nullable=False, server_default=""))


def downgrade() -> None:
    op.drop_column("queries", "leased_tab")
