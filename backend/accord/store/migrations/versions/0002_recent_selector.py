"""Rename the selector `uniform` to `recent` where it preferred recent segments.

Before this revision, `uniform` drew uniformly in the first round only. Later rounds, and the control pairs of other
selectors, preferred recent segments, which is what `recent` does. Experiments keep their behaviour, and queries say how
they were selected.
"""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

EXPERIMENTS = sa.table("experiments", sa.column("id", sa.String), sa.column("config", sa.JSON))


def upgrade() -> None:
    _rename_in_settings("uniform", "recent")
    # The first round ends with the first reward version.
    op.execute(
        "UPDATE queries SET selector = 'recent' WHERE selector = 'uniform' AND created_at > "
        "(SELECT min(created_at) FROM reward_versions WHERE reward_versions.experiment_id = queries.experiment_id)"
    )


def downgrade() -> None:
    _rename_in_settings("recent", "uniform")
    op.execute("UPDATE queries SET selector = 'uniform' WHERE selector = 'recent'")


def _rename_in_settings(old: str, new: str) -> None:
    connection = op.get_bind()
    for id, config in connection.execute(sa.select(EXPERIMENTS.c.id, EXPERIMENTS.c.config)).all():
        if config.get("query_selection") == old:
            changed = config | {"query_selection": new}
            connection.execute(EXPERIMENTS.update().where(EXPERIMENTS.c.id == id).values(config=changed))
