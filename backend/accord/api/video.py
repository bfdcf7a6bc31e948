"""Responses with videos. They support HTTP range requests, so that a browser can seek."""

import logging
import re
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass

from fastapi import Request
from fastapi.responses import RedirectResponse, Response
from sqlalchemy.orm import Session

from accord.api.dependencies import AppState, Auth
from accord.domain.errors import BlobDamaged, BlobMissing, BlobUnreadable
from accord.store.blobs import BlobStore

log = logging.getLogger(__name__)

#: how long the URL of a redirect is valid
_SIGNED_SECONDS = 3600.0
_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


@dataclass(frozen=True, slots=True)
class ByteRange:
    """Bytes from `start` up to but not including `stop`."""

    start: int
    stop: int


@contextmanager
def repairing(auth: Auth, render_again: Callable[[Session], None]) -> Generator[None]:
    """If a video is missing or damaged, has it rendered again for the next request. This one fails nevertheless.

    Args:
        render_again: changes the row of the video in a transaction.
    """
    try:
        yield
    except BlobUnreadable as error:
        log.warning("%s It is rendered again.", error)
        with auth.app.database.transaction() as session:
            render_again(session)
        raise


def video_response(request: Request, app: AppState, key: str, size: int, etag: str) -> Response:
    """A stored video that never changes, or the requested range of it; with `clip_redirects`, where to get it.

    Args:
        size: in bytes; 0 if it was deleted.
        etag: with quotation marks.

    Raises:
        BlobMissing, BlobDamaged: if the video is missing, or does not have this size.
    """
    headers = {"Accept-Ranges": "bytes", "ETag": etag, "Cache-Control": "private, max-age=31536000, immutable"}
    if etag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    if size == 0:
        raise BlobMissing(key)
    signed = app.blobs.signed_url(key, _SIGNED_SECONDS) if app.settings.clip_redirects else None
    if signed is not None:
        if app.blobs.size(key) != size:
            raise _incomplete(key, size)
        return RedirectResponse(signed, 307, {"Cache-Control": "no-store"})
    wanted = parse_range(request.headers.get("range", ""), size)
    if request.headers.get("if-range", etag) != etag:
        wanted = None
    if wanted is None:
        return Response(whole_video(app.blobs, key, size), 200, headers, media_type="video/mp4")
    if wanted.start >= wanted.stop:
        return Response(status_code=416, headers=headers | {"Content-Range": f"bytes */{size}"})
    headers["Content-Range"] = f"bytes {wanted.start}-{wanted.stop - 1}/{size}"
    content = app.blobs.read_range(key, wanted.start, wanted.stop)
    if len(content) != wanted.stop - wanted.start:
        raise _incomplete(key, size)
    return Response(content, 206, headers, media_type="video/mp4")


def whole_video(blobs: BlobStore, key: str, size: int) -> bytes:
    """The blob of a video. Raises BlobDamaged if it does not have the size that was stored."""
    content = blobs.read(key)
    if len(content) != size:
        raise _incomplete(key, size)
    return content


def _incomplete(key: str, size: int) -> BlobDamaged:
    return BlobDamaged(key, f"it does not have the {size} bytes that were stored")


def parse_range(header: str, size: int) -> ByteRange | None:
    """The single range of a Range header, limited to the size; an empty one cannot be satisfied.

    None if there is no range, several, or an invalid one; RFC 9110 then lets a server send everything.
    """
    match = _RANGE.fullmatch(header.strip())
    if match is None or match[0] == "bytes=-":
        return None
    first, last = match.groups()
    if not first:
        return ByteRange(max(0, size - int(last)), size)
    stop = size if not last else min(size, int(last) + 1)
    if last and int(last) < int(first):
        return None
    return ByteRange(int(first), stop)
