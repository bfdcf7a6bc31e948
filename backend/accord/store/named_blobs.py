"""The blobs that rows name."""

from dataclasses import dataclass

from sqlalchemy import inspect, null, select
from sqlalchemy.orm import Session

from accord.store.tables import (
    Base,
    ClipRow,
    ClipViewRow,
    PolicyCheckpointRow,
    RecordingRow,
    RecordingViewRow,
    RewardVersionRow,
    SegmentRow,
)

SEGMENT = "segment"
REWARD_VERSION = "reward version"
#: what the blobs of a table are -> the table, with the column of the id to show
_TABLES: dict[str, tuple[type[Base], str]] = {
    SEGMENT: (SegmentRow, "id"),
    REWARD_VERSION: (RewardVersionRow, "id"),
    "checkpoint": (PolicyCheckpointRow, "id"),
    "recording": (RecordingRow, "id"),
    "clip": (ClipRow, "id"),
    "view of clip": (ClipViewRow, "clip_id"),
    "video of recording": (RecordingViewRow, "recording_id"),
}


@dataclass(frozen=True, slots=True)
class NamedBlob:
    """A blob, and the row that names it."""

    key: str
    #: `SEGMENT`, `REWARD_VERSION`, "clip", ...
    what: str
    #: of the row
    id: str
    #: None where the row does not store it
    size_bytes: int | None = None


def named_blobs(session: Session) -> list[NamedBlob]:
    """Every blob that a row names.

    The database may be of an earlier version: tables that it lacks are skipped, and no column is read that a migration
    added to its table.
    """
    existing = set(inspect(session.connection()).get_table_names())
    found: list[NamedBlob] = []
    for what, (rows, id_column) in _TABLES.items():
        if rows.__tablename__ in existing:
            columns = rows.__table__.c
            statement = select(columns.blob_key, columns[id_column]).where(columns.blob_key.is_not(None))
            if "size_bytes" in columns:
                # The blob of a video of 0 bytes was deleted, to be rendered again when somebody asks for it.
                statement = statement.add_columns(columns.size_bytes).where(columns.size_bytes > 0)
            else:
                statement = statement.add_columns(null())
            found += [NamedBlob(key, what, id, size_bytes) for key, id, size_bytes in session.execute(statement)]
    return found
