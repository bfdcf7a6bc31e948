"""The arrays of segments, for scripted teachers."""

from fastapi import APIRouter, Request
from fastapi.responses import Response

from accord.api.dependencies import AuthDep, SegmentId
from accord.domain.errors import SegmentNotFound
from accord.domain.permissions import require_returns
from accord.services import access, collect

router = APIRouter(tags=["segments"])
_MEDIA_TYPE = "application/octet-stream"


@router.get(
    "/segments/{segment_id}/arrays",
    response_class=Response,
    responses={
        200: {"content": {_MEDIA_TYPE: {}}, "description": "The arrays, as safetensors."},
        304: {"description": "The arrays in the caller's cache are current."},
    },
    summary="Get a segment's arrays",
)
def get_segment_arrays(segment_id: SegmentId, request: Request, auth: AuthDep) -> Response:
    """Observations, actions, true rewards and simulator states, as safetensors. Not for labellers.

    They never change, so programs may cache them.
    """
    with auth.reading() as caller:
        require_returns(caller.role)
        key = collect.blob_key(caller.session, segment_id)
        if not access.sees(caller.session, caller.user, collect.experiment_of(caller.session, segment_id)):
            raise SegmentNotFound(segment_id)
    etag = f'"{segment_id}"'
    headers = {"ETag": etag, "Cache-Control": "private, max-age=31536000, immutable"}
    if etag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(auth.app.blobs.read(key), 200, headers, media_type=_MEDIA_TYPE)
