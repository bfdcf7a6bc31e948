"""A person at the labelling view: waits for pairs as a person does, and presses keys."""

import time
from dataclasses import dataclass

from playwright.sync_api import Page, Request, TimeoutError, expect

from support.waiting import PATIENCE_SECONDS

#: a busy machine renders, trains and runs a browser at once
PATIENCE_MS = round(1000 * PATIENCE_SECONDS)
#: a key that came too soon after the pair is ignored by the page: a person presses it again
RETRY_MS = 1_500

#: the pair has played for a while
_LOOKED = """() => Number(document.querySelector("canvas").dataset.frame) >= 8
  || Number(document.querySelector("[data-stage]").dataset.loops) > 0"""


@dataclass(frozen=True, slots=True)
class Pair:
    """What is on screen."""

    query: str
    left: str
    right: str


class Labeller:
    def __init__(self, page: Page) -> None:
        self.page = page
        self.stage = page.get_by_test_id("stage")
        self._on_their_way: set[Request] = set()
        page.on("request", self._sent)
        page.on("requestfinished", self._done)
        page.on("requestfailed", self._done)

    def open(self, url: str, experiment_id: str) -> Pair:
        self.page.goto(f"{url}/experiments/{experiment_id}/label")
        return self.pair()

    def pair(self) -> Pair:
        """The pair on screen, once both clips play."""
        expect(self.stage).to_have_attribute("data-state", "playing", timeout=PATIENCE_MS)
        names = ("data-query", "data-left", "data-right")
        return Pair(*(self.stage.get_attribute(name) or "" for name in names))

    def wait_for_clips(self, pairs_ahead: int) -> None:
        """Until so many pairs follow the one on screen, and no clip of any is on its way."""
        expect(self.stage).to_have_attribute("data-ahead", str(pairs_ahead), timeout=PATIENCE_MS)
        deadline = time.monotonic() + PATIENCE_SECONDS
        while self._on_their_way and time.monotonic() < deadline:
            self.page.wait_for_timeout(50)
        assert not self._on_their_way

    def press(self, key: str) -> Pair:
        """Answers the pair on screen; returns the pair that was answered, when it has left the screen."""
        pair = self.pair()
        self._look()
        for _ in range(PATIENCE_MS // RETRY_MS):
            self.page.keyboard.press(key)
            if self._leaves(pair):
                return pair
        raise AssertionError(f"{key} did not answer {pair}")

    def undo(self, pair: Pair) -> None:
        """Z brings the pair back on screen."""
        self.page.keyboard.press("z")
        expect(self.stage).to_have_attribute("data-query", pair.query)
        assert self.pair() == pair, "a pair comes back with the sides it had"

    def _sent(self, request: Request) -> None:
        if request.url.endswith(".mp4"):
            self._on_their_way.add(request)

    def _done(self, request: Request) -> None:
        self._on_their_way.discard(request)

    def _look(self) -> None:
        """Nobody answers within a third of a second, and the page does not believe it: eight frames are 0.4 s."""
        self.page.wait_for_function(_LOOKED, timeout=PATIENCE_MS)

    def _leaves(self, pair: Pair) -> bool:
        left = "query => document.querySelector('[data-stage]')?.dataset.query !== query"
        try:
            self.page.wait_for_function(left, arg=pair.query, timeout=RETRY_MS)
        except TimeoutError:
            return False
        return True
