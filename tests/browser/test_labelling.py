"""A person labels with the keyboard, and the reward model is trained on the labels."""

import re
import time

from playwright.sync_api import expect

from browser.fixture_types import NewExperiment, SignIn
from browser.labeller import PATIENCE_MS, Labeller
from browser.service import Service
from support.waiting import PATIENCE_SECONDS

#: the label of each key, as P(left preferred)
LEFT_PREFERRED = {"ArrowLeft": 1.0, "ArrowRight": 0.0, "ArrowUp": 0.5}
KEYS = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowLeft", "ArrowRight"]


def test_labels_with_undos_and_a_skip_train_reward_versions_and_the_policy(
    service: Service, new_experiment: NewExperiment, sign_in: SignIn
) -> None:
    experiment = new_experiment("Ten labels", initial_labels=10, labels_per_version=5)
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
    assert _states(service, skipped.query) == ["skip"]
    assert _states(service, undone.query) == ["label", "undone", "label"]

    # Two labels of this version are undone. It stays as it is, and the next one is trained without them.
    first = _versions(service, experiment)
    kept, changed, removed = list(chosen)[:-2], *list(chosen)[-2:]
    for query in (removed, changed):
        page.keyboard.press("z")
        expect(labeller.pair_view).to_have_attribute("data-query", query)
        expect(page.get_by_test_id("version-notice")).to_contain_text("trained on the label you undid")
    expect(page.get_by_test_id("own-labels")).to_have_text("8")
    new_key = "ArrowLeft" if chosen[changed] == "ArrowRight" else "ArrowRight"
    assert labeller.press(new_key).query == changed
    expect(page.get_by_test_id("version-notice")).not_to_contain_text("the label you undid")
    assert labeller.press("ArrowDown").query == removed
    assert _versions(service, experiment) == first

    # Pairs from later segments appear automatically, possibly after a notice that there is none.
    later = {labeller.press(key).query: key for key in [*KEYS, "ArrowLeft"]}
    expect(page.get_by_role("progressbar", name="All labels")).to_have_attribute("aria-valuenow", "15")
    expect(page.get_by_test_id("reward-version")).to_contain_text(
        re.compile("Reward version [2-9]"), timeout=PATIENCE_MS
    )
    trained = {query: chosen[query] for query in kept} | {changed: new_key} | later
    assert {query: _stored_label(service, query) for query in trained} == {
        query: LEFT_PREFERRED[key] for query, key in trained.items()
    }
    assert _states(service, removed) == ["label", "undone", "skip"]
    stored, (_, number, parent, label_count, watermark), *_ = _versions(service, experiment)
    assert [stored] == first
    assert (number, parent) == (2, stored[0])
    used = service.rows(
        "select query_id from labels where experiment_id = ? and state = 'label' and revision <= ?",
        experiment,
        watermark,
    )
    assert {*kept, changed} < {query for (query,) in used} <= set(trained)
    assert label_count == len(used)
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


def _states(service: Service, query: str) -> list[str]:
    """The states of all revisions of the label of a pair, oldest first."""
    rows = service.rows(
        "select r.state from label_revisions r join labels l on l.id = r.label_id where l.query_id = ? "
        "order by r.revision",
        query,
    )
    return [state for (state,) in rows]


def _versions(service: Service, experiment: str) -> list[tuple[str, int, str | None, int, int]]:
    """Id, number, parent, number of labels and watermark of every reward version."""
    return service.rows(
        "select id, number, parent_id, label_count, label_watermark from reward_versions"
        " where experiment_id = ? order by number",
        experiment,
    )


def test_a_person_labels_a_skirmish(service: Service, new_experiment: NewExperiment, sign_in: SignIn) -> None:
    experiment = new_experiment("A skirmish", task="3m", segment_steps=12)
    page = sign_in("Lena")
    labeller = Labeller(page)
    labeller.open(service.url, experiment)
    expect(page.get_by_text("Marine 3").first).to_be_visible()
    chosen = {labeller.press(key).query: key for key in KEYS[:2]}
    expect(page.get_by_test_id("own-labels")).to_have_text("2")
    assert {query: _stored_label(service, query) for query in chosen} == {
        query: LEFT_PREFERRED[key] for query, key in chosen.items()
    }
