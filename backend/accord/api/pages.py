"""Serves the built page: its files, and index.html for every other path, which the page routes itself."""

from pathlib import Path

from fastapi.responses import FileResponse, PlainTextResponse
from starlette.exceptions import HTTPException
from starlette.types import Receive, Scope, Send

FOLDER = Path(__file__).parent.parent / "static"
_NOT_BUILT = (
    "This installation does not contain the page. Build it with `python frontend/build_page.py`, or reinstall from a "
    "wheel. The API works without it and is described at /api/docs."
)
#: folder of the files whose names contain a hash of their content
_HASHED = "assets"


class Page:
    """ASGI application for every path without a route."""

    def __init__(self, folder: Path = FOLDER) -> None:
        self._folder = folder.resolve()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        path = scope["path"].lstrip("/")
        if path == "api" or path.startswith("api/"):
            raise HTTPException(404)
        if scope["method"] not in {"GET", "HEAD"}:
            raise HTTPException(405, headers={"Allow": "GET, HEAD"})
        await self._response(path)(scope, receive, send)

    def _response(self, path: str) -> FileResponse | PlainTextResponse:
        index = self._folder / "index.html"
        if not index.is_file():
            return PlainTextResponse(_NOT_BUILT, 503)
        file = (self._folder / path).resolve() if "\0" not in path else index
        if path and file.is_relative_to(self._folder) and file.is_file():
            immutable_file = path.startswith(f"{_HASHED}/")
            return FileResponse(
                file, headers={"Cache-Control": "public, max-age=31536000, immutable" if immutable_file else "no-cache"}
            )
        if path.startswith(f"{_HASHED}/"):
            raise HTTPException(404)
        return FileResponse(index, headers={"Cache-Control": "no-cache"})
