"""Retention: deletes blobs that no row names, and what nothing needs of experiments that are over.

Labels, their pairs with segments, reward versions, recordings and the last policy are kept, and clips unless asked for.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy.orm import Session

from accord.services import blob_deletion, inventory
from accord.services.collect import replayed_clip_key
from accord.store import pruning
from accord.store.blobs import BlobStore, OnBlobs, StoredBlob
from accord.store.database import Database
from accord.store.pruning import Unneeded
from accord.store.tables import ClipViewRow, PolicyCheckpointRow, RecordingViewRow, utc_now


@dataclass(frozen=True, slots=True)
class Group:
    """Blobs of one kind to delete."""

    what: str
    blobs: list[StoredBlob]
    #: deletes the rows that name them
    delete_rows: Callable[[Session], object]

    @property
    def size_bytes(self) -> int:
        return sum(blob.size_bytes for blob in self.blobs)


def find(database: Database, blobs: BlobStore, hours: float, *, clips: bool = False) -> list[Group]:
    """What can be deleted. Changes nothing.

    Args:
        hours: blobs without a row are kept for this long, because their rows may still be written, and everything of
            an experiment is kept for this long after its end.
        clips: also the clips of experiments that are over; each is rendered again after the first request for it.

    Raises:
        DatabaseUnreachable: if the database cannot be reached.
    """
    before = utc_now() - timedelta(hours=hours)
    # Listed before the rows are read, so that the row of a listed blob is either there or was deleted.
    stored = {blob.key: blob for blob in blobs.stored()}
    with database.reading() as session:
        required = inventory.required(session)
        segments = pruning.unpaired_segments(session, before)
        checkpoints = pruning.earlier_checkpoints(session, before)
        rendered = pruning.rendered_clips(session, before) if clips else []
        views = [(table, pruning.requested_videos(session, table, before)) for table in (ClipViewRow, RecordingViewRow)]
    named = {blob.key for blob in required} | inventory.optional_keys(required)
    # Earlier versions stored equal clips of several experiments once.
    names = Counter(blob.key for blob in required)
    names.subtract(
        key for rows in (segments, checkpoints, rendered, *(rows for _, rows in views)) for key in _keys(rows)
    )
    deletable = {key: blob for key, blob in stored.items() if names[key] <= 0}
    unused = [blob for key, blob in stored.items() if key not in named and blob.written_at < before]
    return [
        Group("blobs that no row names", unused, lambda _session: None),
        _group(
            "segments without a pair, of experiments that are over",
            deletable,
            [*_keys(segments), *(replayed_clip_key(key) for key in _keys(segments))],
            lambda session: pruning.delete_segments(session, _ids(segments)),
        ),
        _group(
            "checkpoints but the last, of experiments that are over",
            deletable,
            _keys(checkpoints),
            lambda session: pruning.delete_rows(session, PolicyCheckpointRow, _ids(checkpoints)),
        ),
        _group(
            "videos from other cameras and of policies, of experiments that are over",
            deletable,
            [key for _, rows in views for key in _keys(rows)],
            lambda session: [pruning.delete_rows(session, table, _ids(rows)) for table, rows in views],
        ),
        _group(
            "clips of experiments that are over",
            deletable,
            _keys(rendered),
            lambda session: pruning.mark_deleted(session, _ids(rendered)),
        ),
    ]


def delete(
    database: Database,
    blobs: BlobStore,
    hours: float,
    on_blobs: OnBlobs = lambda _done, _total: None,
    *,
    clips: bool = False,
) -> list[Group]:
    """Deletes what `find` finds, and returns it. The service may keep running.

    Args:
        on_blobs: called with the number of blobs deleted so far, and of all.

    Raises:
        BlobsInUse: if a backup runs.
        DatabaseUnreachable: as `find`.
    """
    with blob_deletion.suspended(database, "accord prune"):
        groups = find(database, blobs, hours, clips=clips)
        with database.transaction() as session:
            for group in groups:
                group.delete_rows(session)
        # If this is interrupted, the rest has no rows, and is found the next time.
        keys = sorted({blob.key for group in groups for blob in group.blobs})
        for done, key in enumerate(keys, 1):
            blobs.delete(key)
            on_blobs(done, len(keys))
    return groups


def _group(
    what: str, deletable: Mapping[str, StoredBlob], keys: Iterable[str], delete_rows: Callable[[Session], object]
) -> Group:
    return Group(what, [deletable[key] for key in dict.fromkeys(keys) if key in deletable], delete_rows)


def _keys(rows: Sequence[Unneeded]) -> list[str]:
    return [row.blob_key for row in rows]


def _ids(rows: Sequence[Unneeded]) -> list[tuple[str, ...]]:
    return [row.id for row in rows]
