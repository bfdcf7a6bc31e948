"""Which experiments a user may see and label: all by default, or those that an admin has chosen.

Access to an experiment that a user may not see is refused as if it did not exist. Labels on pairs that were shown
before access was taken away are still accepted.
"""

from collections.abc import Sequence

from sqlalchemy.orm import Session

from accord.domain.enums import Role
from accord.domain.errors import ExperimentNotFound
from accord.domain.permissions import may_run_experiments
from accord.services.accounts import Caller
from accord.store import access
from accord.store.tables import UserRow


def sees_all(user: Caller) -> bool:
    """Whether no experiment is hidden from the user."""
    return user.all_experiments or may_run_experiments(Role(user.role))


def sees(session: Session, user: Caller, experiment_id: str) -> bool:
    """Whether the user may see and label the experiment."""
    return sees_all(user) or access.has(session, user.id, experiment_id)


def require(session: Session, user: Caller, experiment_id: str) -> None:
    """Raises ExperimentNotFound if the user may not see the experiment."""
    if not sees(session, user, experiment_id):
        raise ExperimentNotFound(experiment_id)


def limit(session: Session, user: UserRow, *, all_experiments: bool, experiment_ids: Sequence[str] = ()) -> None:
    """Lets a user see all experiments, or only some, and ends their leases in the others.

    Raises:
        ExperimentNotFound: if one of them does not exist.
    """
    wanted = list(dict.fromkeys(experiment_ids)) if not all_experiments else []
    missing = set(wanted) - access.existing(session, wanted)
    if missing:
        raise ExperimentNotFound(min(missing))
    user.all_experiments = all_experiments
    session.flush()
    access.replace(session, user.id, wanted)
    if not all_experiments and not may_run_experiments(Role(user.role)):
        access.release_others(session, user.id, wanted)
