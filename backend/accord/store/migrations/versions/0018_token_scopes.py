"""Give bearer tokens a name, and limits on their role and experiment. Earlier ones have none."""

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("tokens", sa.Column("name", sa.String(100), nullable=False, server_default=""))
    op.add_column("tokens", sa.Column("role", sa.String(20), nullable=True))
    op.add_column("tokens", sa.Column("experiment_id", sa.String(32), nullable=True))
    op.create_index("ix_tokens_experiment_id", "tokens", ["experiment_id"])


def downgrade() -> None:
    op.drop_index("ix_tokens_experiment_id", "tokens")
    for column in ("experiment_id", "role", "name"):
        op.drop_column("tokens", column)
