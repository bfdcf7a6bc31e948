"""Add the Idempotency-Key of the request that created an experiment. Earlier experiments have none."""

import sqlalchemy as sa
from alembic import op

revision = "0022"
down_revision = "0021"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("experiments", sa.Column("creation_key", sa.String(64), nullable=True))
    op.create_index("ix_experiments_creation_key", "experiments", ["owner_id", "creation_key"], unique=True)


def downgrade() -> None:
    op.drop_index("ix_experiments_creation_key", "experiments")
    op.drop_column("experiments", "creation_key")
