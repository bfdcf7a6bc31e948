"""Leases on pieces of work, so that one worker at a time does each. Never more than these three verbs."""

from sqlalchemy.orm import Session

from accord.services.clock import now_and_end
from accord.store import processes


def claim(session: Session, subject: str, holder: str, lease_seconds: float) -> bool:
    """Takes a subject, for example policy:exp_..., that nobody holds, or whose holder was silent for too long."""
    now, until = now_and_end(lease_seconds)
    return processes.take_claim(session, subject, holder, until, now)


def heartbeat(session: Session, subject: str, holder: str, lease_seconds: float) -> bool:
    """Holds on to a subject. Returns False if another has it by now: stop working on it."""
    _, until = now_and_end(lease_seconds)
    return processes.renew_claim(session, subject, holder, until)


def release(session: Session, subject: str, holder: str) -> None:
    """Gives a subject back; nothing happens where another holds it."""
    processes.drop_claim(session, subject, holder)
