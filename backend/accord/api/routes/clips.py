"""Clips of segments, from every camera, and still images of them."""

import logging
from collections.abc import Callable
from typing import Annotated

from fastapi import APIRouter, Path, Request
from fastapi.responses import Response

from accord.api import responses, schemas
from accord.api.dependencies import Auth, AuthDep, CallerSession, ClipId
from accord.api.video import repairing, video_response, whole_video
from accord.domain.enums import ClipCamera
from accord.domain.errors import ClipNotFound
from accord.services import access, clip_views, clips
from accord.store.tables import ClipRow, ClipViewRow
from mapt.errors import ClipNotRead
from mapt.rendering.stills import animation, thumbnail

log = logging.getLogger(__name__)
router = APIRouter(tags=["clips"])
CameraPath = Annotated[ClipCamera, Path(description="Where the camera is: side or top.")]


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
        row = _visible(caller, clip_id)
        key, size = row.blob_key, row.size_bytes
    assert key is not None  # a ready clip has a blob
    with repairing(auth, lambda session: clips.render_again(session, clip_id)):
        return video_response(request, auth.app, key, size, f'"{clip_id}-{size}"')


@router.put("/clips/{clip_id}/views/{camera}", summary="Request a clip from another camera")
def request_view(clip_id: ClipId, camera: CameraPath, auth: AuthDep) -> schemas.ClipView:
    """Returns the state of the view. The first request has it rendered, before the clips of later pairs.

    Ask again until it is ready, which usually takes a second or two.
    """
    with auth.writing() as caller:
        _visible(caller, clip_id)
        return responses.view_response(clip_views.request(caller.session, clip_id, camera))


@router.get(
    "/clips/{clip_id}/views/{camera}.mp4",
    response_class=Response,
    responses={200: {"content": {"video/mp4": {}}, "description": "The whole clip, or a range of it as for a clip."}},
    summary="Get a clip from another camera",
)
def get_view(clip_id: ClipId, camera: CameraPath, request: Request, auth: AuthDep) -> Response:
    """H.264 video in MP4 with the same frames from another direction. It never changes, so browsers may cache it."""
    with auth.reading() as caller:
        _visible(caller, clip_id)
        row = clip_views.get(caller.session, clip_id, camera)
        key, size = row.blob_key, row.size_bytes
    assert key is not None  # a ready view has a blob
    with repairing(auth, lambda session: clip_views.render_again(session, ClipViewRow, clip_id, camera)):
        return video_response(request, auth.app, key, size, f'"{clip_id}-{camera}-{size}"')


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
    return _image(clip_id, request, auth, thumbnail, "image/jpeg")


@router.get(
    "/clips/{clip_id}.gif",
    response_class=Response,
    responses={
        200: {"content": {"image/gif": {}}, "description": "The animation."},
        304: {"description": "The animation in the browser's cache is current."},
    },
    summary="Get a clip as a GIF",
)
def get_animation(clip_id: ClipId, request: Request, auth: AuthDep) -> Response:
    """A clip as a GIF of 320 pixels width, for pages and messages that play no video. It never changes."""
    return _image(clip_id, request, auth, animation, "image/gif")


def _image(clip_id: str, request: Request, auth: Auth, make: Callable[[bytes], bytes], media_type: str) -> Response:
    with auth.reading() as caller:
        row = _visible(caller, clip_id)
        key, size = row.blob_key, row.size_bytes
    assert key is not None  # a ready clip has a blob
    etag = f'"{clip_id}-{media_type}"'
    headers = {"ETag": etag, "Cache-Control": "private, max-age=31536000, immutable"}
    if etag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    with repairing(auth, lambda session: clips.render_again(session, clip_id)):
        content = whole_video(auth.app.blobs, key, size)
    try:
        image = make(content)
    except ClipNotRead as error:
        log.warning("%s: %s", clip_id, error)
        raise ClipNotFound(clip_id) from error
    return Response(image, 200, headers, media_type=media_type)


def _visible(caller: CallerSession, clip_id: str) -> ClipRow:
    """A clip that is ready to play. Raises ClipNotFound, also if its experiment is hidden from the caller."""
    row = clips.get(caller.session, clip_id)
    if not access.sees(caller.session, caller.user, row.experiment_id):
        raise ClipNotFound(clip_id)
    return row
