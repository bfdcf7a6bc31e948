"""Answers with more in them: slightly better."""

from playwright.sync_api import Page, expect

from browser.accessibility import violations_of
from browser.fixture_types import NewExperiment, SignIn
from browser.labeller import Labeller
from browser.service import Service
from support.waiting import until


def test_slightly_better_is_one_key_or_one_tap_where_the_experiment_has_five_answers(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    experiment = new_experiment("Five answers", answer_scale="five")
    page = sign_in("Lena")
    labeller = Labeller(page)
    labeller.open(service.url, experiment)
    answers = {key: labeller.press(key).query for key in ("Shift+ArrowLeft", "Shift+ArrowRight", "ArrowLeft")}
    expect(page.get_by_test_id("status")).to_contain_text("Left is better")
    assert [shown_label(service, query) for query in answers.values()] == [0.75, 0.25, 1.0]

    labeller.pair()
    labeller.wait_until_played()
    page.keyboard.press("h")
    history = page.locator(".history")
    expect(history.get_by_role("button", name="Right is slightly better")).to_be_visible()
    history.get_by_role("button", name="Left is slightly better").click()
    expect(page.get_by_role("heading", name="answered “Left is slightly better”")).to_be_visible()
    labeller.press("ArrowUp")
    until(lambda: shown_label(service, answers["Shift+ArrowLeft"]) == 0.5, "the changed label is stored")
    page.keyboard.press("h")
    page.keyboard.press("?")
    expect(page.get_by_role("dialog")).to_contain_text("slightly better")
    page.keyboard.press("Escape")
    found = violations_of(page, "five answers")
    assert not found, "\n".join(found)

    phone = sign_in("Paul", has_touch=True, is_mobile=True)
    phone.set_viewport_size({"width": 390, "height": 844})
    on_phone = Labeller(phone)
    on_phone.open(service.url, experiment)
    on_phone.wait_until_played()
    buttons = answer_buttons(phone)
    assert len(buttons) == 6
    for box in buttons:
        assert box["height"] >= 48
        assert box["y"] + box["height"] <= 844, "the answers are on screen"
    query = on_phone.pair().query
    phone.get_by_role("button", name="Bottom slightly").tap()
    expect(phone.get_by_test_id("status")).to_contain_text("Bottom is slightly better")
    assert shown_label(service, query) == 0.25


def test_three_answers_have_four_buttons_and_ignore_shift(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    experiment = new_experiment("Three answers")
    page = sign_in("Lena")
    labeller = Labeller(page)
    labeller.open(service.url, experiment)
    assert len(answer_buttons(page)) == 4
    query = labeller.press("Shift+ArrowLeft").query
    assert shown_label(service, query) == 1.0


def answer_buttons(page: Page) -> list[dict[str, float]]:
    """Boxes of the answer buttons."""
    return [dict(button.bounding_box() or {}) for button in page.locator(".choices button").all()]


def shown_label(service: Service, query: str) -> float | None:
    """The stored label as P(left preferred)."""
    statement = "select value, left_segment from labels where query_id = ? and state = 'label'"
    until(lambda: bool(service.rows(statement, query)), "the label is stored")
    ((value, left),) = service.rows(statement, query)
    return value if left == 0 else 1 - value
