"""The rules before the first pair, while labelling, and after a change; the keys."""

from playwright.sync_api import expect

from browser.accessibility import violations_of
from browser.fixture_types import NewExperiment, SignIn
from browser.labeller import Labeller
from browser.service import Service
from support.waiting import until

RULES = """# Goal

Prefer the team that runs **forward**. See [the paper](https://example.org) or [this](javascript:alert(1)).

- Ignore the colours.

<img src=x onerror="window.hacked = 1"><script>window.hacked = 1</script>
"""


def test_a_first_visit_begins_with_the_rules_and_labels_name_their_revision(
    service: Service, researcher: str, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    experiment = new_experiment("With rules", instructions=RULES)
    page = sign_in("Lena")
    page.goto(f"{service.url}/experiments/{experiment}/label")
    expect(page.get_by_role("heading", name="Before you start")).to_be_visible()
    expect(page.locator("strong", has_text="forward")).to_be_visible()
    expect(page.get_by_role("link", name="the paper")).to_be_visible()
    expect(page.get_by_role("link", name="this")).to_have_count(0)
    expect(page.get_by_text("<script>")).to_be_visible()
    found = violations_of(page, "first visit")
    assert service.rows("select id from queries where leased_by is not null and experiment_id = ?", experiment) == []
    expect(page.get_by_role("button", name="Start labelling")).to_be_focused()
    page.keyboard.press("Enter")
    labeller = Labeller(page)
    first = labeller.press("ArrowLeft")

    pair = labeller.pair()
    page.keyboard.press("r")
    expect(page.get_by_role("dialog").locator("strong", has_text="forward")).to_be_visible()
    found += violations_of(page, "rules")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Escape")
    assert labeller.pair() == pair, "keys do not answer behind the dialog"
    page.keyboard.press("?")
    expect(page.get_by_role("dialog")).to_contain_text("Undo the last label")
    found += violations_of(page, "keys")
    page.get_by_role("button", name="Close").click()
    page.reload()
    assert labeller.pair() == pair

    with service.api(researcher) as api:
        example = page.get_by_test_id("pair").get_attribute("data-left")
        query = api.get(f"/experiments/{experiment}/queries", params={"status": "open"}).json()["items"]
        clip = next(
            side["clip_url"].removeprefix("/api/v1/clips/").removesuffix(".mp4")
            for item in query
            for side in item["segments"]
            if side["segment_id"] == example
        )
        api.patch(f"/experiments/{experiment}", json={"instructions": f"Run far.\n\n![A good gait](clip:{clip})"})
    page.reload()
    expect(page.get_by_role("heading", name="The rules have changed")).to_be_visible()
    video = page.locator("video")
    video.wait_for()
    page.wait_for_function("() => document.querySelector('video').readyState >= 2")
    found += violations_of(page, "changed rules")
    second = labeller.press("ArrowLeft")
    revisions = "select instructions_revision from labels where query_id = ?"
    until(
        lambda: [service.rows(revisions, each.query) for each in (first, second)] == [[(1,)], [(2,)]],
        "each label has the revision of the rules that was shown",
    )
    assert page.evaluate("window.hacked") is None
    assert found == []


def test_the_rules_are_within_reach_on_a_phone(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    experiment = new_experiment("Rules on a phone", instructions=RULES)
    page = sign_in("Tina", has_touch=True, is_mobile=True)
    # Held sideways, the button that starts is below the rules.
    page.set_viewport_size({"width": 780, "height": 360})
    labeller = Labeller(page)
    labeller.open(service.url, experiment)
    assert page.evaluate("scrollY") == 0
    page.set_viewport_size({"width": 390, "height": 844})
    rules = page.get_by_role("button", name="Rules")
    box = rules.bounding_box()
    assert box is not None
    assert min(box["width"], box["height"]) >= 47.5
    assert box["y"] + box["height"] <= 844
    rules.tap()
    expect(page.get_by_role("dialog").locator("strong", has_text="forward")).to_be_visible()
