"""The built page: its files, and index.html for the paths that the page routes itself."""

import gzip
from pathlib import Path

import httpx
import pytest
from starlette.exceptions import HTTPException
from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send

from accord.api.pages import Page


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    built = tmp_path / "static"
    (built / "assets").mkdir(parents=True)
    (built / "index.html").write_text("<!doctype html><title>Accord</title>")
    (built / "assets" / "index-1a2b.js").write_text("let x = 1")
    (built / "icon.svg").write_text("<svg/>")
    (tmp_path / "secret.txt").write_text("a secret")
    return built


async def request(
    folder: Path, path: str, method: str = "GET", headers: dict[str, str] | None = None
) -> httpx.Response:
    page = Page(folder)

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await page(scope, receive, send)
        except HTTPException as error:
            await PlainTextResponse("refused", error.status_code)(scope, receive, send)

    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as client:
        return await client.request(method, path, headers=headers)


@pytest.mark.anyio
@pytest.mark.parametrize("path", ["/", "/experiments/exp_1", "/sign-in/abc", "/api/docs", "/index.html"])
async def test_paths_of_the_page_return_index_html(folder: Path, path: str) -> None:
    response = await request(folder, path)
    assert response.status_code == 200
    assert "<title>Accord</title>" in response.text
    assert response.headers["cache-control"] == "no-cache"


@pytest.mark.anyio
async def test_files_with_a_hash_in_their_name_are_cached_forever(folder: Path) -> None:
    script = await request(folder, "/assets/index-1a2b.js")
    assert "javascript" in script.headers["content-type"]
    assert "immutable" in script.headers["cache-control"]
    assert (await request(folder, "/icon.svg")).headers["cache-control"] == "no-cache"


@pytest.mark.anyio
async def test_clients_get_the_smallest_copy_that_they_accept(folder: Path) -> None:
    script = folder / "assets" / "index-1a2b.js"
    for coding, ending in (("gzip", ".gz"), ("br", ".br")):
        compressed = gzip.compress(script.read_bytes()) if coding == "gzip" else b"not decoded here"
        script.with_name(script.name + ending).write_bytes(compressed)

    async def coding_for(accepted: str) -> tuple[str | None, int]:
        path = "/assets/index-1a2b.js"
        response = await request(folder, path, method="HEAD", headers={"Accept-Encoding": accepted})
        assert "javascript" in response.headers["content-type"]
        assert response.headers["vary"] == "Accept-Encoding"
        return response.headers.get("content-encoding"), int(response.headers["content-length"])

    assert await coding_for("gzip, deflate, br") == ("br", len(b"not decoded here"))
    assert (await coding_for("gzip;q=0.8, br;q=0"))[0] == "gzip"
    assert await coding_for("identity") == (None, script.stat().st_size)
    response = await request(folder, "/assets/index-1a2b.js", headers={"Accept-Encoding": "gzip"})
    assert response.text == "let x = 1"


@pytest.mark.anyio
@pytest.mark.parametrize("path", ["/assets/gone-9z.js", "/api/v1/nothing", "/api"])
async def test_missing_files_and_unknown_api_paths_are_404(folder: Path, path: str) -> None:
    assert (await request(folder, path)).status_code == 404


@pytest.mark.anyio
@pytest.mark.parametrize("path", ["/%2e%2e/secret.txt", "/..%2fsecret.txt", "/assets/%2e%2e/%2e%2e/secret.txt", "/%00"])
async def test_files_outside_the_folder_are_not_sent(folder: Path, path: str) -> None:
    response = await request(folder, path)
    assert "a secret" not in response.text


@pytest.mark.anyio
async def test_page_that_was_not_built_is_a_503_error(tmp_path: Path) -> None:
    response = await request(tmp_path / "nowhere", "/")
    assert response.status_code == 503
    assert "frontend/build_page.py" in response.text


@pytest.mark.anyio
async def test_post_to_the_page_is_refused(folder: Path) -> None:
    assert (await request(folder, "/", "POST")).status_code == 405


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"
