"""A person labels with the keyboard, and the reward model is trained on the labels."""

import time

from playwright.sync_api import expect

from browser.fixture_types import NewExperiment, SignIn
from browser.labeller import PATIENCE_MS, Labeller, Pair
from browser.service import Service
from support.waiting import PATIENCE_SECONDS

#: the label of each key, as P(left preferred)
LEFT_PREFERRED = {"ArrowLeft": 1.0, "ArrowRight": 0.0, "ArrowUp": 0.5}
KEYS = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowLeft", "ArrowRight"]


def test_labels_with_an_undo_and_a_skip_train_a_reward_version_and_the_policy(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    experiment = new_experiment("Ten labels", initial_labels=10)
    page = sign_in("Lena")
    labeller = Labeller(page)
    labeller.open(service.url, experiment)

    skipped = labeller.press("ArrowDown")
    chosen = {labeller.press(key).query: key for key in KEYS}
    undone = labeller.press("ArrowRight")
    labeller.undo(undone)
    assert labeller.press("ArrowLeft") == undone
    chosen[undone.query] = "ArrowLeft"
    chosen |= {labeller.press(key).query: key for key in KEYS[1:]}

    expect(page.get_by_test_id("version-notice")).to_contain_text("Reward version 1", timeout=PATIENCE_MS)
    expect(page.get_by_test_id("reward-version")).to_contain_text("Reward version 1")
    expect(page.get_by_test_id("own-labels")).to_have_text("10")
    assert len(chosen) == 10
    assert {query: _stored_label(service, query) for query in chosen} == {
        q: LEFT_PREFERRED[key] for q, key in chosen.items()
    }
    assert _states(service, skipped) == ["skip"]
    assert _states(service, undone) == ["label", "undone", "label"]

    # Pairs from later segments appear automatically, possibly after a notice that there is none.
    for key in KEYS:
        labeller.press(key)
    expect(page.get_by_role("progressbar", name="All labels")).to_have_attribute("aria-valuenow", "15")
    deadline = time.monotonic() + PATIENCE_SECONDS
    while not (trained := _steps_with_a_version(service, experiment)) and time.monotonic() < deadline:
        page.wait_for_timeout(250)
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
