"""The site that `make docs` built, opened as files in a real Chromium."""

import json
from collections.abc import Generator

import pytest
from playwright.sync_api import Page, expect, sync_playwright

import mapt
from support.chromium import chromium
from support.markdown import ROOT
from support.waiting import PATIENCE_SECONDS

pytestmark = pytest.mark.docs
SITE = ROOT / "build" / "site"
PATIENCE_MS = 1000 * PATIENCE_SECONDS


@pytest.fixture
def page() -> Generator[Page]:
    """A page that fails the test when it asks for something outside of the site, or logs an error."""
    problems: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium())
        page = browser.new_page()
        page.on("request", lambda request: request.url.startswith(("file:", "data:")) or problems.append(request.url))
        page.on("console", lambda message: message.type == "error" and problems.append(message.text))
        page.on("pageerror", lambda error: problems.append(str(error)))
        yield page
        browser.close()
    assert problems == []


def test_the_site_is_searched_without_a_server_and_without_a_network(page: Page) -> None:
    page.goto((SITE / "index.html").as_uri())
    box = page.get_by_role("textbox", name="Search")
    box.click()
    # The index is built after the first click. What is written before, on a busy machine, is not searched for; the
    # theme reads the box when a key is released.
    expect(page.locator(".md-search-result__meta")).to_have_text("Type to start searching", timeout=PATIENCE_MS)
    box.press_sequentially("relabelling")
    expect(page.locator(".md-search-result__link").first).to_have_text("Reward models", timeout=PATIENCE_MS)


def test_every_function_of_the_library_has_a_description(page: Page) -> None:
    page.goto((SITE / "api" / "mapt.html").as_uri())
    headings = set(page.locator(".doc-object-name").all_inner_texts())
    assert set(mapt.__all__) - {"make_task", "register_task", "task_names"} <= headings


def test_every_operation_and_schema_of_the_api_has_a_section(page: Page) -> None:
    schema = json.loads((ROOT / "frontend" / "openapi.json").read_text())
    page.goto((SITE / "rest.html").as_uri())
    headings = {text.removesuffix("¶") for text in page.locator("h3").all_inner_texts()}
    operations = {operation["summary"] for path in schema["paths"].values() for operation in path.values()}
    assert operations | schema["components"]["schemas"].keys() == headings
