"""The built page: its files, and index.html for the addresses it routes itself."""

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


async def ask(folder: Path, path: str, method: str = "GET") -> httpx.Response:
    page = Page(folder)

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await page(scope, receive, send)
        except HTTPException as error:
            await PlainTextResponse("refused", error.status_code)(scope, receive, send)

    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as client:
        return await client.request(method, path)


@pytest.mark.anyio
@pytest.mark.parametrize("path", ["/", "/experiments/exp_1", "/label", "/index.html"])
async def test_addresses_of_the_page_get_index_html(folder: Path, path: str) -> None:
    response = await ask(folder, path)
    assert response.status_code == 200
    assert "<title>Accord</title>" in response.text
    assert response.headers["cache-control"] == "no-cache"


@pytest.mark.anyio
async def test_files_are_sent_and_those_with_a_hash_in_their_name_are_kept(folder: Path) -> None:
    script = await ask(folder, "/assets/index-1a2b.js")
    assert "javascript" in script.headers["content-type"]
    assert "immutable" in script.headers["cache-control"]
    assert (await ask(folder, "/icon.svg")).headers["cache-control"] == "no-cache"


@pytest.mark.anyio
@pytest.mark.parametrize("path", ["/assets/gone-9z.js", "/api/v1/nothing", "/api"])
async def test_what_is_missing_is_not_answered_with_the_page(folder: Path, path: str) -> None:
    assert (await ask(folder, path)).status_code == 404


@pytest.mark.anyio
@pytest.mark.parametrize("path", ["/%2e%2e/secret.txt", "/..%2fsecret.txt", "/assets/%2e%2e/%2e%2e/secret.txt", "/%00"])
async def test_nothing_outside_of_the_folder_is_sent(folder: Path, path: str) -> None:
    response = await ask(folder, path)
    assert "a secret" not in response.text


@pytest.mark.anyio
async def test_a_page_that_was_not_built_is_said_with_what_to_do(tmp_path: Path) -> None:
    response = await ask(tmp_path / "nowhere", "/")
    assert response.status_code == 503
    assert "not built" in response.text


@pytest.mark.anyio
async def test_the_page_is_only_read(folder: Path) -> None:
    assert (await ask(folder, "/", "POST")).status_code == 405


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"
