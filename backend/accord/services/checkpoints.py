"""Policy checkpoints: where training goes on after a crash."""

from sqlalchemy.orm import Session

from accord.domain.ids import new_id
from accord.store import rewards
from accord.store.tables import PolicyCheckpointRow

KEPT = 3


def save(  # noqa: PLR0917 (a row's fields in their order)
    session: Session, experiment_id: str, steps: int, iteration: int, blob_key: str, reward_version_id: str | None
) -> PolicyCheckpointRow:
    """Names a checkpoint whose blob is stored. Give each blob a key of its own: a stored key keeps its first bytes."""
    row = PolicyCheckpointRow(
        id=new_id("chk"),
        experiment_id=experiment_id,
        steps=steps,
        iteration=iteration,
        blob_key=blob_key,
        reward_version_id=reward_version_id,
    )
    session.add(row)
    session.flush()
    return row


def newest(session: Session, experiment_id: str) -> PolicyCheckpointRow | None:
    found = rewards.checkpoints(session, experiment_id, 1)
    return found[0] if found else None


def prune(session: Session, experiment_id: str, keep: int = KEPT) -> list[str]:
    """Forgets all but the newest checkpoints; returns the keys of their blobs.

    Delete those blobs after the transaction is committed: a crash then leaves an orphan blob, never a row without one.
    """
    kept = [row.id for row in rewards.checkpoints(session, experiment_id, keep)]
    return rewards.delete_checkpoints_but(session, experiment_id, kept)
