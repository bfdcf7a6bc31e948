"""A person labels with the keyboard, and the reward model is trained on the labels."""

import time

from playwright.sync_api import expect

from browser.fixture_types import NewExperiment, SignIn
from browser.labeller import PATIENCE_MS, Labeller, Pair
from browser.service import Service

#: the label of each key, as P(left preferred)
LEFT_PREFERRED = {"ArrowLeft": 1.0, "ArrowRight": 0.0, "ArrowUp": 0.5}
KEYS = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowLeft", "ArrowRight"] * 4


def test_twenty_labels_with_an_undo_and_a_skip_train_a_reward_version(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    experiment = new_experiment("Twenty labels")
    page = sign_in("Lena")
    labeller = Labeller(page)
    labeller.open(service.url, experiment)

    skipped = labeller.press("ArrowDown")
    chosen = {labeller.press(key).query: key for key in KEYS[:10]}
    undone = labeller.press("ArrowRight")
    labeller.undo(undone)
    assert labeller.press("ArrowLeft") == undone
    chosen[undone.query] = "ArrowLeft"
    chosen |= {labeller.press(key).query: key for key in KEYS[11:]}

    expect(page.get_by_test_id("version-notice")).to_contain_text("Reward version 1", timeout=PATIENCE_MS)
    expect(page.get_by_test_id("reward-version")).to_contain_text("Reward version 1")
    expect(page.get_by_test_id("own-labels")).to_have_text("20")
    assert len(chosen) == 20
    assert {query: _stored_label(service, query) for query in chosen} == {
        q: LEFT_PREFERRED[key] for q, key in chosen.items()
    }
    assert _states(service, skipped) == ["skip"]
    assert _states(service, undone) == ["label", "undone", "label"]


def test_the_policy_trains_on_the_reward_version_and_new_pairs_follow(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    experiment = new_experiment("Policy training continues")
    labeller = Labeller(sign_in("Lena"))
    labeller.open(service.url, experiment)
    for key in KEYS:
        labeller.press(key)
    # Pairs from later segments appear automatically, possibly after a notice that there is none.
    for key in KEYS[:4]:
        labeller.press(key)
    expect(labeller.page.get_by_role("progressbar", name="All labels")).to_have_attribute("aria-valuenow", "24")
    deadline = time.monotonic() + PATIENCE_MS / 1000
    while not (trained := _steps_with_a_version(service, experiment)) and time.monotonic() < deadline:
        labeller.page.wait_for_timeout(250)
    assert trained > 0


def _steps_with_a_version(service: Service, experiment: str) -> int:
    """The last environment step at which the policy was trained on a reward version."""
    rows = service.rows(
        "select max(step) from metrics"
        " where experiment_id = ? and name = 'learned_return' and reward_version_id is not null",
        experiment,
    )
    return rows[0][0] or 0


def _stored_label(service: Service, query: str) -> float:
    """The stored label as P(left preferred), in the order that the person saw."""
    rows = service.rows(
        "select value, left_segment, response_seconds from labels where query_id = ? and state = 'label'", query
    )
    ((value, left_segment, response_seconds),) = rows
    assert 0.3 <= response_seconds < 600
    return value if left_segment == 0 else 1.0 - value


def _states(service: Service, pair: Pair) -> list[str]:
    """The states of all revisions of the label of a pair, oldest first."""
    rows = service.rows(
        "select r.state from label_revisions r join labels l on l.id = r.label_id where l.query_id = ? "
        "order by r.revision",
        pair.query,
    )
    return [state for (state,) in rows]
