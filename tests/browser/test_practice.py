"""From the first visit over a practice round to the hundredth label, with the keyboard alone."""

import csv
import io
import re

import pytest
from playwright.sync_api import Page, expect

from browser.accessibility import violations_of
from browser.fixture_types import NewExperiment, SignIn
from browser.labeller import Labeller
from browser.service import Service
from support.waiting import until

pytestmark = pytest.mark.slow

LABELS = 100
KEYS = ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowRight", "ArrowLeft")
EXPLANATION = "It runs further."


#: the last labels are equal, and given without watching
HASTY = 20

#: presses a key as soon as the page accepts an answer, until no pair is left. In the page, so that a busy machine does
#: not make the answers slow.
_ANSWER_AT_ONCE = """() => new Promise((done) => {
  const press = () => {
    const pair = document.querySelector("[data-pair]");
    if (!pair && document.querySelector("[data-reason=all_labelled]")) return done();
    if (pair?.dataset.state === "playing" && Number(document.querySelector("canvas").dataset.frame) >= 7)
      document.body.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowUp", bubbles: true }));
    setTimeout(press, 20);
  };
  press();
})"""


def mark_for_practice(researcher: Page, number: int, answer: str, explanation: str) -> None:
    """Give the known answer of a pair in the table of all labels, and make it a practice pair."""
    pair = researcher.locator("tbody", has=researcher.get_by_label(f"Known answer of pair {number}", exact=True))
    older = researcher.get_by_role("button", name="Older pairs")
    expect(pair.or_(older).first).to_be_visible()
    while not pair.is_visible():
        older.click()
    pair.get_by_label(re.compile("^Known answer")).select_option(answer)
    for_practice = pair.get_by_label("for practice")
    for_practice.click()
    expect(for_practice).to_be_checked()
    reason = pair.get_by_label(re.compile("^Explanation"))
    reason.fill(explanation)
    reason.press("Tab")


def answer_hastily(page: Page) -> list[str]:
    """Give the labels that are left at once. The page says so, once. Returns what axe finds."""
    notice = page.get_by_test_id("pace-notice")
    expect(notice).to_be_empty()
    page.evaluate(_ANSWER_AT_ONCE)
    expect(page.get_by_test_id("no-pair")).to_have_attribute("data-reason", "all_labelled")
    expect(notice).to_contain_text("very quick")
    found = violations_of(page, "hasty answers")
    notice.get_by_role("button").click()
    expect(notice).to_be_empty()
    return found


def test_practice_and_a_hundred_labels_with_the_keyboard_alone(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn, researcher: str
) -> None:
    experiment = new_experiment("A hundred", label_budget=LABELS, initial_labels=LABELS, labels_per_version=LABELS)
    judge = sign_in("Rosa", "researcher")
    with service.api(researcher) as api:
        address = f"/experiments/{experiment}"
        *_, second, first = until(
            lambda: found if len(found := api.get(f"{address}/queries?status=open").json()["items"]) > 1 else None
        )
        judge.goto(f"{service.url}/experiments/{experiment}/labels")
        mark_for_practice(judge, first["number"], "1", EXPLANATION)
        mark_for_practice(judge, second["number"], "0.5", "")
        until(lambda: len(api.post(f"{address}/practice").json()["items"]) == 2)

        page = sign_in("Lena")
        labeller = Labeller(page)
        page.goto(f"{service.url}/experiments/{experiment}/label")
        expect(page.get_by_role("button", name="Practise on 2 pairs")).to_be_visible()
        page.keyboard.press("Tab")
        page.keyboard.press("Enter")
        expect(page.get_by_test_id("practice")).to_contain_text("answers do not count. Pair 1 of 2")
        shown = labeller.pair()
        assert shown.query == first["id"]
        better = first["segments"][0]["segment_id"]
        found = violations_of(page, "practice")
        labeller.wait_until_played()
        page.keyboard.press("ArrowLeft" if shown.left == better else "ArrowRight")
        expect(page.get_by_test_id("feedback")).to_have_text(f"✓ Correct: {EXPLANATION}")
        found += violations_of(page, "feedback")
        page.keyboard.press("Enter")
        expect(page.get_by_test_id("practice")).to_contain_text("Pair 2 of 2")
        labeller.pair()
        labeller.wait_until_played()
        page.keyboard.press("ArrowLeft")
        expect(page.get_by_test_id("feedback")).to_have_text("The researcher chose equally good.")
        page.keyboard.press("Enter")
        expect(page.get_by_role("heading", name="1 of 2 correct")).to_be_visible()
        found += violations_of(page, "end of practice")
        assert service.rows("select id from labels where experiment_id = ?", experiment) == []
        page.keyboard.press("Enter")

        for count in range(LABELS - HASTY):
            labeller.press(KEYS[count % len(KEYS)])
            if count == 0:
                # Practice is within reach of the rules, and the pair on screen comes back.
                pair = labeller.pair()
                page.keyboard.press("r")
                page.get_by_role("button", name="Practise on 2 pairs").press("Enter")
                page.get_by_role("button", name="End practice").press("Enter")
                assert labeller.pair() == pair
        found += answer_hastily(page)
        expect(page.get_by_test_id("own-labels")).to_have_text(str(LABELS))
        assert api.get(address).json()["labels"]["labels"] == LABELS
        table = csv.DictReader(io.StringIO(api.get(f"{address}/queries.csv").text))
        labelled = [row["query_id"] for row in table if row["state"]]
    assert len(labelled) == len(set(labelled)) == LABELS
    assert not {first["id"], second["id"]} & set(labelled)
    assert found == []
