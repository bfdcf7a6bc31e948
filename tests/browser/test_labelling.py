"""A person labels with the keyboard, and the reward model learns from it."""

import time

from playwright.sync_api import expect

from browser.fixture_types import NewExperiment, SignIn
from browser.labeller import PATIENCE_MS, Labeller, Pair
from browser.service import Service

#: what a key says: how much of the label the left clip gets
LEFT_SHARE = {"ArrowLeft": 1.0, "ArrowRight": 0.0, "ArrowUp": 0.5}
KEYS = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowLeft", "ArrowRight"] * 4


def test_twenty_labels_an_undo_and_a_skip_by_keyboard_bring_a_reward_version(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    experiment = new_experiment("Twenty labels")
    page = sign_in("Lena")
    labeller = Labeller(page)
    labeller.open(service.url, experiment)

    skipped = labeller.press("ArrowDown")
    said = {labeller.press(key).query: key for key in KEYS[:10]}
    regretted = labeller.press("ArrowRight")
    labeller.undo(regretted)
    assert labeller.press("ArrowLeft") == regretted
    said[regretted.query] = "ArrowLeft"
    said |= {labeller.press(key).query: key for key in KEYS[11:]}

    expect(page.get_by_test_id("version-news")).to_contain_text("reward version 1", timeout=PATIENCE_MS)
    expect(page.get_by_test_id("reward-version")).to_contain_text("Reward version 1")
    expect(page.get_by_test_id("mine")).to_have_text("20")
    assert len(said) == 20
    assert {query: _left_share(service, query) for query in said} == {q: LEFT_SHARE[key] for q, key in said.items()}
    assert _states(service, skipped) == ["skip"]
    assert _states(service, regretted) == ["label", "undone", "label"]


def test_the_policy_takes_up_the_reward_version_and_asks_again(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    experiment = new_experiment("The policy goes on")
    labeller = Labeller(sign_in("Lena"))
    labeller.open(service.url, experiment)
    for key in KEYS:
        labeller.press(key)
    # Pairs of the policy's later segments follow by themselves, whatever the page has to say in between.
    for key in KEYS[:4]:
        labeller.press(key)
    expect(labeller.page.get_by_role("progressbar", name="All labels")).to_have_attribute("aria-valuenow", "24")
    deadline = time.monotonic() + PATIENCE_MS / 1000
    while not (trained := _steps_with_a_version(service, experiment)) and time.monotonic() < deadline:
        labeller.page.wait_for_timeout(250)
    assert trained > 0


def _steps_with_a_version(service: Service, experiment: str) -> int:
    """Environment steps that the policy has learned from a reward version."""
    rows = service.rows(
        "select max(step) from metrics"
        " where experiment_id = ? and name = 'learned_return' and reward_version_id is not null",
        experiment,
    )
    return rows[0][0] or 0


def _left_share(service: Service, query: str) -> float:
    """The stored label, seen from the side that the person saw."""
    rows = service.rows(
        "select value, left_segment, response_seconds from labels where query_id = ? and state = 'label'", query
    )
    ((value, left_segment, response_seconds),) = rows
    assert 0.3 <= response_seconds < 600
    return value if left_segment == 0 else 1.0 - value


def _states(service: Service, pair: Pair) -> list[str]:
    """Every word ever said of a pair, in order."""
    rows = service.rows(
        "select r.state from label_revisions r join labels l on l.id = r.label_id where l.query_id = ? "
        "order by r.revision",
        pair.query,
    )
    return [state for (state,) in rows]
