"""Checks a page with the rules of axe, in the light and the dark theme, at the width of a desktop and of a phone."""

import pytest
from playwright.sync_api import Page


def violations_of(page: Page, what: str) -> list[str]:
    """What axe finds, and whether the page scrolls sideways. The page keeps the desktop's width afterwards."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is missing: pip install -e .[dev]")
    found: list[str] = []
    for scheme, width in (("dark", 390), ("light", 1280)):
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        page.set_viewport_size({"width": width, "height": 800})
        violations = axe.Axe().run(page).response["violations"]
        found += [f"{what}, {scheme}: {each['id']} {each['nodes'][0]['html']}" for each in violations]
        if page.evaluate("document.documentElement.scrollWidth > document.documentElement.clientWidth"):
            found.append(f"{what}, {width}: scrolls sideways")
    return found
