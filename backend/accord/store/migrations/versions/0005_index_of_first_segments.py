"""Index the first segments of queries: without it, deleting a segment searches all queries."""

from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_index("ix_queries_segment_0", "queries", ["segment_0_id"])


def downgrade() -> None:
    op.drop_index("ix_queries_segment_0", table_name="queries")
