"""Clips, with HTTP range requests, so that a browser can seek."""

import logging
import re
from dataclasses import dataclass

from fastapi import APIRouter, Request
from fastapi.responses import Response

from accord.api.dependencies import AuthDep, ClipId
from accord.domain.errors import ClipNotFound
from accord.services import clips
from mapt.errors import ClipNotRead
from mapt.rendering.stills import thumbnail

log = logging.getLogger(__name__)
router = APIRouter(tags=["clips"])
_RANGE = re.compile(r"bytes=(\d*)-(\d*)")


@dataclass(frozen=True, slots=True)
class ByteRange:
    """Bytes from `start` up to but not including `stop`."""

    start: int
    stop: int


@router.get(
    "/clips/{clip_id}.mp4",
    response_class=Response,
    responses={
        200: {"content": {"video/mp4": {}}, "description": "The whole clip."},
        206: {"content": {"video/mp4": {}}, "description": "The requested range."},
        304: {"description": "The clip in the browser's cache is current."},
        416: {"description": "The range is outside the clip."},
    },
    summary="Get a clip",
)
def get_clip(clip_id: ClipId, request: Request, auth: AuthDep) -> Response:
    """H.264 video in MP4. A clip never changes, so browsers may cache it."""
    with auth.reading() as caller:
        row = clips.get(caller.session, clip_id)
        key, size = row.blob_key, row.size_bytes
    assert key is not None  # a ready clip has a blob
    etag = f'"{clip_id}"'
    headers = {"Accept-Ranges": "bytes", "ETag": etag, "Cache-Control": "private, max-age=31536000, immutable"}
    if etag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    wanted = parse_range(request.headers.get("range", ""), size)
    if request.headers.get("if-range", etag) != etag:
        wanted = None
    if wanted is None:
        return Response(auth.app.blobs.read(key), 200, headers, media_type="video/mp4")
    if wanted.start >= wanted.stop:
        return Response(status_code=416, headers=headers | {"Content-Range": f"bytes */{size}"})
    headers["Content-Range"] = f"bytes {wanted.start}-{wanted.stop - 1}/{size}"
    content = auth.app.blobs.read_range(key, wanted.start, wanted.stop)
    return Response(content, 206, headers, media_type="video/mp4")


@router.get(
    "/clips/{clip_id}.jpg",
    response_class=Response,
    responses={
        200: {"content": {"image/jpeg": {}}, "description": "The still image."},
        304: {"description": "The image in the browser's cache is current."},
    },
    summary="Get a still of a clip",
)
def get_thumbnail(clip_id: ClipId, request: Request, auth: AuthDep) -> Response:
    """A frame from the middle of a clip as a small JPEG. It never changes, so browsers may cache it."""
    with auth.reading() as caller:
        key = clips.get(caller.session, clip_id).blob_key
    assert key is not None  # a ready clip has a blob
    etag = f'"{clip_id}-still"'
    headers = {"ETag": etag, "Cache-Control": "private, max-age=31536000, immutable"}
    if etag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    try:
        image = thumbnail(auth.app.blobs.read(key))
    except ClipNotRead as error:
        log.warning("%s: %s", clip_id, error)
        raise ClipNotFound(clip_id) from error
    return Response(image, 200, headers, media_type="image/jpeg")


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
