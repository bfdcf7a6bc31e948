"""How far an experiment is, read from its rows, for the rules of `accord.workers.pacing`."""

from dataclasses import replace

from sqlalchemy.orm import Session

from accord.domain.experiment import ExperimentConfig
from accord.services import select
from accord.store.tables import ExperimentRow, RewardVersionRow
from accord.workers.pacing import Progress, waits_for


def read_progress(
    session: Session, row: ExperimentRow, config: ExperimentConfig, version: RewardVersionRow | None, steps: int
) -> Progress:
    """
    Args:
        config: the experiment's settings, which its row holds as JSON.
        version: the newest one.
        steps: environment steps trained, which the row may not say yet.
    """
    progress = Progress(steps, row.label_count, version.label_count if version else None)
    # Pairs are counted only where labels are missing: it takes longer than the rest.
    waits = waits_for(config, progress) is not None
    return replace(progress, exhausted=waits and select.exhausted(session, row))
