"""Serves the built page: its files, and index.html for every other path, which the page routes itself.

The build compresses the text files, so that the server only chooses among them.
"""

import mimetypes
from pathlib import Path

from fastapi.responses import FileResponse, PlainTextResponse
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import Receive, Scope, Send

FOLDER = Path(__file__).parent.parent / "static"
#: the only path below /api that is a page
DOCUMENTATION = "api/docs"
_NOT_BUILT = (
    "This installation does not contain the page. Build it with `python frontend/build_page.py`, or reinstall from a "
    "wheel. The API works without it and is described at /api/docs."
)
#: folder of the files whose names contain a hash of their content
_HASHED = "assets"
_REFUSED = frozenset({"q=0", "q=0.0", "q=0.00", "q=0.000"})
#: longest path that is looked up
_MAX_PATH_CHARACTERS = 2000
#: content codings and the endings of their files, the smallest first
_CODINGS = (("br", ".br"), ("gzip", ".gz"))


class Page:
    """ASGI application for every path without a route."""

    def __init__(self, folder: Path = FOLDER) -> None:
        self._folder = folder.resolve()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope["path"].lstrip("/")
        if len(path) > _MAX_PATH_CHARACTERS:
            raise HTTPException(414)
        if path == "api" or (path.startswith("api/") and path != DOCUMENTATION):
            raise HTTPException(404)
        if scope["method"] not in {"GET", "HEAD"}:
            raise HTTPException(405, headers={"Allow": "GET, HEAD"})
        await self._response(path, _accepted_codings(Headers(scope=scope)))(scope, receive, send)

    def _response(self, path: str, accepted: frozenset[str]) -> FileResponse | PlainTextResponse:
        index = self._folder / "index.html"
        if not index.is_file():
            return PlainTextResponse(_NOT_BUILT, 503)
        file = self._file(path)
        if file is not None:
            immutable_file = path.startswith(f"{_HASHED}/")
            return _file_response(
                file, "public, max-age=31536000, immutable" if immutable_file else "no-cache", accepted
            )
        if path.startswith(f"{_HASHED}/"):
            raise HTTPException(404)
        return _file_response(index, "no-cache", accepted)

    def _file(self, path: str) -> Path | None:
        """The file at a path within the folder; None if there is none."""
        try:
            file = (self._folder / path).resolve()
            return file if path and file.is_relative_to(self._folder) and file.is_file() else None
        except (OSError, ValueError):
            return None  # a name that no file can have, for example of 300 characters


def _file_response(file: Path, cache_control: str, accepted: frozenset[str]) -> FileResponse:
    """A file, or its compressed copy if there is one that the client accepts."""
    media_type = mimetypes.guess_type(file.name)[0]
    headers = {"Cache-Control": cache_control}
    for coding, ending in _CODINGS:
        copy = file.with_name(file.name + ending)
        if copy.is_file():
            headers["Vary"] = "Accept-Encoding"
            if coding in accepted:
                return FileResponse(copy, headers=headers | {"Content-Encoding": coding}, media_type=media_type)
    return FileResponse(file, headers=headers, media_type=media_type)


def _accepted_codings(headers: Headers) -> frozenset[str]:
    """The content codings that a client names without refusing them by `q=0`."""
    codings = (each.strip().partition(";") for each in headers.get("accept-encoding", "").lower().split(","))
    return frozenset(name.strip() for name, _, quality in codings if quality.replace(" ", "") not in _REFUSED)
