"""Checks a page with the rules of axe, in the light and the dark theme, at the width of a desktop and of a phone."""

import pytest
from playwright.sync_api import Page

#: the rules that the page breaks, each with its first element. The thousands of passed checks stay in the browser.
_RUN = """(alike) => axe.run(alike ? { exclude: [[alike]] } : document, { resultTypes: ["violations"] })
  .then(({ violations }) => violations.map(({ id, nodes }) => `${id} ${nodes[0].html}`))"""


def violations_of(page: Page, what: str, alike: str | None = None) -> list[str]:
    """What axe finds, and whether the page scrolls sideways. The page keeps the desktop's width afterwards.

    `alike` selects elements to leave out, because others that look alike stand for them.
    """
    axe = pytest.importorskip("axe_playwright_python.base", reason="axe is missing: pip install -e .[dev]")
    if page.evaluate("!('axe' in window)"):
        page.evaluate(axe.AXE_SCRIPT)
    found: list[str] = []
    for scheme, width in (("dark", 390), ("light", 1280)):
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        page.set_viewport_size({"width": width, "height": 800})
        found += [f"{what}, {scheme}: {each}" for each in page.evaluate(_RUN, alike)]
        if page.evaluate("document.documentElement.scrollWidth > document.documentElement.clientWidth"):
            found.append(f"{what}, {width}: scrolls sideways")
    return found
