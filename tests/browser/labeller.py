"""Drives the labelling page as a person does: waits for a pair and presses keys."""

import re
import time
from dataclasses import dataclass

from playwright.sync_api import Page, Request, TimeoutError, expect

from support.waiting import PATIENCE_SECONDS

#: long enough for a busy machine that renders, trains and runs a browser at once
PATIENCE_MS = round(1000 * PATIENCE_SECONDS)
#: the page ignores a key pressed too soon after the pair appeared: press it again after this
RETRY_MS = 1_500

#: What the labelling page shows: the pair whose clips play, as [query, left segment, right segment]; the button below
#: the rules on a first visit; or null, while it loads. One question to the browser, which asks itself before every
#: repaint: Playwright's own assertions ask once a second after the first few.
_SHOWN = """() => {
  const pair = document.querySelector("[data-pair]");
  if (pair?.dataset.state === "playing") return [pair.dataset.query, pair.dataset.left, pair.dataset.right];
  return [...document.querySelectorAll("button")].some((each) => each.innerText === "Start labelling") && "rules";
}"""

#: whether the pair has played for at least eight frames (0.4 s): the page ignores earlier labels
_PLAYED = """() => Number(document.querySelector("canvas").dataset.frame) >= 8
  || Number(document.querySelector("[data-pair]").dataset.loops) > 0"""


def open_link(page: Page, link: str) -> None:
    """Open a sign-in link and redeem it."""
    page.goto(link)
    page.get_by_role("button", name=re.compile("^Sign in as ")).click()


@dataclass(frozen=True, slots=True)
class Pair:
    """The query on screen and its segments."""

    query: str
    left: str
    right: str


class Labeller:
    def __init__(self, page: Page) -> None:
        self.page = page
        self.pair_view = page.get_by_test_id("pair")
        self._loading: set[Request] = set()
        page.on("request", self._on_request)
        page.on("requestfinished", self._on_request_end)
        page.on("requestfailed", self._on_request_end)

    def open(self, url: str, experiment_id: str) -> Pair:
        self.page.goto(f"{url}/experiments/{experiment_id}/label")
        return self.pair()

    def pair(self) -> Pair:
        """Wait until both clips play, past the rules on a first visit; return the pair."""
        while (shown := self.page.wait_for_function(_SHOWN, timeout=PATIENCE_MS).json_value()) == "rules":
            self.page.get_by_role("button", name="Start labelling").click()
        return Pair(*shown)

    def wait_for_clips(self, upcoming: int) -> None:
        """Wait until this many pairs follow the one on screen and all clips are downloaded."""
        expect(self.pair_view).to_have_attribute("data-upcoming", str(upcoming), timeout=PATIENCE_MS)
        deadline = time.monotonic() + PATIENCE_SECONDS
        while self._loading and time.monotonic() < deadline:
            self.page.wait_for_timeout(50)
        assert not self._loading

    def press(self, key: str) -> Pair:
        """Label the pair on screen with a key; return it after it has left the screen."""
        pair = self.pair()
        self.wait_until_played()
        for _ in range(PATIENCE_MS // RETRY_MS):
            self.page.keyboard.press(key)
            if self._has_left(pair):
                return pair
        raise AssertionError(f"{key} did not label {pair}")

    def undo(self, pair: Pair) -> None:
        """Press Z and check that this pair is on screen again."""
        self.page.keyboard.press("z")
        expect(self.pair_view).to_have_attribute("data-query", pair.query)
        assert self.pair() == pair, "the pair must come back with the same sides"

    def _on_request(self, request: Request) -> None:
        if request.url.endswith(".mp4"):
            self._loading.add(request)

    def _on_request_end(self, request: Request) -> None:
        self._loading.discard(request)

    def wait_until_played(self) -> None:
        self.page.wait_for_function(_PLAYED, timeout=PATIENCE_MS)

    def _has_left(self, pair: Pair) -> bool:
        left = "query => document.querySelector('[data-pair]')?.dataset.query !== query"
        try:
            self.page.wait_for_function(left, arg=pair.query, timeout=RETRY_MS)
        except TimeoutError:
            return False
        return True
