"""Which blobs the rows need, and which belong to them although no row names them."""

from collections.abc import Iterable

from sqlalchemy.orm import Session

from accord.services.collect import replayed_clip_key
from accord.services.publish import card_key, ensemble_key
from accord.store.named_blobs import REWARD_VERSION, SEGMENT, NamedBlob, named_blobs


def required(session: Session) -> list[NamedBlob]:
    """Every blob that must exist: those that rows name, and the descriptions of reward models.

    The database may be of an earlier version.
    """
    named = named_blobs(session)
    cards = [NamedBlob(card_key(blob.key), blob.what, blob.id) for blob in named if blob.what == REWARD_VERSION]
    return named + cards


def optional_keys(blobs: Iterable[NamedBlob]) -> set[str]:
    """Keys of blobs that may exist beside these: ensembles of reward versions, and clips stored with segments."""
    found: set[str] = set()
    for blob in blobs:
        if blob.what == REWARD_VERSION and not blob.key.endswith(".json"):
            found.add(ensemble_key(blob.key))
        elif blob.what == SEGMENT:
            found.add(replayed_clip_key(blob.key))
    return found
