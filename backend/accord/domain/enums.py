"""Enumerations shared by the database, the API and the page."""

from enum import StrEnum


class Role(StrEnum):
    """A user's role; `accord.domain.permissions` says what each may do."""

    LABELLER = "labeller"
    RESEARCHER = "researcher"
    ADMIN = "admin"
    #: a program that labels; unlike a labeller, it may read true returns
    TEACHER = "teacher"


class ExperimentStatus(StrEnum):
    """Whether an experiment runs, and how it ended."""

    RUNNING = "running"
    PAUSED = "paused"
    CANCELLED = "cancelled"
    FINISHED = "finished"
    FAILED = "failed"

    @property
    def is_over(self) -> bool:
        """Whether it has ended for good, unless a failed one is resumed."""
        return self in {ExperimentStatus.CANCELLED, ExperimentStatus.FINISHED, ExperimentStatus.FAILED}


class Phase(StrEnum):
    """What the policy worker is doing with a running experiment."""

    QUEUED = "queued"
    COLLECTING = "collecting"
    WAITING_FOR_LABELS = "waiting_for_labels"
    TRAINING = "training"
    EVALUATING = "evaluating"
    DONE = "done"


class QueryStatus(StrEnum):
    """State of a query: waiting for its clips, ready to label, labelled, or failed."""

    RENDERING = "rendering"
    OPEN = "open"
    CLOSED = "closed"
    #: one of its clips could not be rendered; it is never shown
    FAILED = "failed"


class ClipStatus(StrEnum):
    """State of a clip."""

    PENDING = "pending"
    READY = "ready"
    FAILED = "failed"


class CreditStatus(StrEnum):
    """State of a request for what a reward version learned."""

    PENDING = "pending"
    READY = "ready"
    FAILED = "failed"


class ClipCamera(StrEnum):
    """A camera that is rendered on demand. Every clip is rendered with the camera that suits its task."""

    SIDE = "side"
    TOP = "top"


class RecordingCamera(StrEnum):
    """A camera for recordings of policies, which are all rendered on demand."""

    #: the camera of clips, which suits the task
    FOLLOW = "follow"
    SIDE = "side"
    TOP = "top"


class WorkerRole(StrEnum):
    """What a worker process does."""

    RENDER = "render"
    REWARD = "reward"
    POLICY = "policy"


class WorkerState(StrEnum):
    """What a worker process does, as itself or its supervisor reported last."""

    STARTING = "starting"
    #: there is nothing to do for its role
    IDLE = "idle"
    WORKING = "working"
    #: its experiment waits for labels or for a reward version
    WAITING = "waiting"
    #: its work failed; it retries after a pause
    BACKING_OFF = "backing_off"
    #: its process ended; its supervisor starts another one
    RESTARTING = "restarting"
    STOPPED = "stopped"


class AuditAction(StrEnum):
    """What the audit log records."""

    SIGNED_IN = "signed_in"
    #: by a token, link or invitation that is not valid; the log has only some of them
    SIGN_IN_FAILED = "sign_in_failed"
    SIGNED_OUT = "signed_out"
    JOINED = "joined"
    USER_ADDED = "user_added"
    USER_CHANGED = "user_changed"
    USER_REMOVED = "user_removed"
    #: their browsers, tokens and links became invalid
    SIGN_INS_REVOKED = "sign_ins_revoked"
    LINK_CREATED = "link_created"
    TOKEN_CREATED = "token_created"
    TOKEN_REVOKED = "token_revoked"
    INVITATION_CREATED = "invitation_created"
    INVITATION_WITHDRAWN = "invitation_withdrawn"
    EXPERIMENT_CREATED = "experiment_created"
    EXPERIMENT_IMPORTED = "experiment_imported"
    EXPERIMENT_CHANGED = "experiment_changed"
    EXPERIMENT_DELETED = "experiment_deleted"
    EXPERIMENT_EXPORTED = "experiment_exported"
    EXPERIMENT_SHARED = "experiment_shared"
    SHARE_REVOKED = "share_revoked"
    LABELS_EXCLUDED = "labels_excluded"
    LABELLER_CHANGED = "labeller_changed"
    GOLD_CHANGED = "gold_changed"
    WEBHOOK_CREATED = "webhook_created"
    WEBHOOK_DELETED = "webhook_deleted"


class WebhookEvent(StrEnum):
    """What webhooks are told."""

    REWARD_VERSION_PUBLISHED = "reward_version.published"
    #: it finished, failed or was cancelled
    EXPERIMENT_FINISHED = "experiment.finished"
    #: the policy waits for labels
    LABELS_DUE = "labels.due"
    #: on request of an admin only
    TEST = "test"


class DeliveryStatus(StrEnum):
    """State of an event for a webhook."""

    PENDING = "pending"
    DELIVERED = "delivered"
    #: given up after the last attempt
    FAILED = "failed"
