"""Clips from other cameras: requested by whoever looks at a pair, rendered before the clips of later pairs."""

from dataclasses import dataclass

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from accord.domain.enums import ClipCamera, ClipStatus
from accord.domain.errors import ClipNotFound
from accord.services import clips
from accord.services.clips import MAX_ATTEMPTS
from accord.services.lease import now_and_end
from accord.store import clip_views
from accord.store.tables import ClipViewRow, ExperimentRow, SegmentRow


@dataclass(frozen=True, slots=True)
class ViewJob:
    """A view to render."""

    clip_id: str
    camera: ClipCamera
    experiment_id: str
    #: name of the task, which determines the model to draw
    task: str
    #: blob of the segment's arrays
    segment_blob_key: str


def request(session: Session, clip_id: str, camera: ClipCamera) -> ClipViewRow:
    """The view of a clip, which is rendered if nobody has asked for it before.

    Raises:
        ClipNotFound: if there is no such clip, or it is not rendered yet.
    """
    clip = clips.get(session, clip_id)
    found = clip_views.get(session, clip_id, camera)
    if found is not None:
        return found
    row = ClipViewRow(clip_id=clip_id, camera=camera.value, experiment_id=clip.experiment_id)
    try:
        with session.begin_nested():
            session.add(row)
    except IntegrityError:  # another request was faster
        return clip_views.lock(session, clip_id, camera) or row
    return row


def get(session: Session, clip_id: str, camera: ClipCamera) -> ClipViewRow:
    """A view that is ready to play.

    Raises:
        ClipNotFound: if nobody has requested it, or it is not rendered yet.
    """
    row = clip_views.get(session, clip_id, camera)
    if row is None or row.status != ClipStatus.READY:
        raise ClipNotFound(clip_id)
    return row


def claim_pending(session: Session, holder: str, lease_seconds: float) -> ViewJob | None:
    """Claims the view that was requested last; None if there is none. The third attempt is the last."""
    now, until = now_and_end(lease_seconds)
    while (row := clip_views.lock_pending(session, now)) is not None:
        if row.attempts < MAX_ATTEMPTS:
            row.attempts += 1
            row.claimed_by, row.claimed_until = holder, until
            session.flush()
            segment = session.get_one(SegmentRow, clips.get(session, row.clip_id).segment_id)
            experiment = session.get_one(ExperimentRow, row.experiment_id)
            return ViewJob(
                row.clip_id, ClipCamera(row.camera), row.experiment_id, str(experiment.config["task"]), segment.blob_key
            )
        row.status = ClipStatus.FAILED.value
        session.flush()
    return None


def heartbeat(session: Session, job: ViewJob, holder: str, lease_seconds: float) -> bool:
    """Renews a claim. Returns False if another worker holds it."""
    row = clip_views.lock(session, job.clip_id, job.camera)
    if row is None or row.status != ClipStatus.PENDING or row.claimed_by != holder:
        return False
    _, row.claimed_until = now_and_end(lease_seconds)
    return True


def finish(session: Session, job: ViewJob, blob_key: str, size_bytes: int) -> None:
    """Marks a view as ready. Nothing happens if its experiment was deleted meanwhile."""
    row = clip_views.lock(session, job.clip_id, job.camera)
    if row is not None:
        row.status, row.blob_key, row.size_bytes = ClipStatus.READY.value, blob_key, size_bytes
        row.claimed_by = row.claimed_until = None


def fail(session: Session, job: ViewJob) -> None:
    """Records that it cannot be rendered. The clip itself and its queries are not affected."""
    row = clip_views.lock(session, job.clip_id, job.camera)
    if row is not None and row.status == ClipStatus.PENDING:
        row.status = ClipStatus.FAILED.value
        row.claimed_by = row.claimed_until = None
