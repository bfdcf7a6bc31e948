"""What worker processes say of themselves, for the page."""

from sqlalchemy.orm import Session

from accord.store import processes
from accord.store.tables import WorkerRow, utc_now


def report(  # noqa: PLR0917 (a row's fields in their order)
    session: Session,
    worker_id: str,
    role: str,
    pid: int,
    state: str,
    detail: str = "",
    restarts: int | None = None,
) -> None:
    """A sign of life. Another pid than before means that the process was started anew.

    Args:
        worker_id: role and slot, for example policy-0.
        state: starting, idle, working, backing_off or stopped.
        restarts: how often its supervisor has restarted it; None leaves the number as it is.
    """
    now = utc_now()
    row = processes.worker(session, worker_id)
    if row is None:
        session.add(WorkerRow(id=worker_id, role=role, pid=pid, state=state, detail=detail, restarts=restarts or 0))
        return
    if row.pid != pid:
        row.pid, row.started_at = pid, now
    row.role, row.state, row.detail, row.heartbeat_at = role, state, detail, now
    if restarts is not None:
        row.restarts = restarts


def all(session: Session) -> list[WorkerRow]:
    """Every worker that ever reported, by id."""
    return processes.workers(session)
