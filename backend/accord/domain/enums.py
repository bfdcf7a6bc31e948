"""The words of DESIGN as types: the same in code, API, page and docs."""

from enum import StrEnum


class Role(StrEnum):
    """What a user may do; see `accord.domain.permissions`."""

    LABELLER = "labeller"
    RESEARCHER = "researcher"
    ADMIN = "admin"
    #: a program that labels: it alone, with researchers, may read true returns
    TEACHER = "teacher"


class ExperimentStatus(StrEnum):
    """What its owner wants of an experiment, and how it ended."""

    RUNNING = "running"
    PAUSED = "paused"
    CANCELLED = "cancelled"
    FINISHED = "finished"
    FAILED = "failed"


class Phase(StrEnum):
    """What the policy worker is doing with a running experiment right now."""

    QUEUED = "queued"
    COLLECTING = "collecting"
    WAITING_FOR_LABELS = "waiting_for_labels"
    TRAINING = "training"
    EVALUATING = "evaluating"
    DONE = "done"


class QueryStatus(StrEnum):
    """A query waits for its clips, is open to label, and is closed when it has its labels."""

    RENDERING = "rendering"
    OPEN = "open"
    CLOSED = "closed"
    #: a clip of it could not be made; it is never offered
    FAILED = "failed"


class ClipStatus(StrEnum):
    PENDING = "pending"
    READY = "ready"
    FAILED = "failed"


class WorkerRole(StrEnum):
    RENDER = "render"
    REWARD = "reward"
    POLICY = "policy"


#: P(segment 0 is preferred): the only values a label may have
LABEL_VALUES: tuple[float, ...] = (0.0, 0.5, 1.0)
