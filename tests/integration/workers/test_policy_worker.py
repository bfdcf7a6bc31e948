import pytest

from accord.domain.enums import ExperimentStatus
from accord.services import experiments
from accord.workers.heartbeat import ClaimLost
from accord.workers.model_store import read_reward_model
from accord.workers.policy_worker import PolicyWorker
from integration.workers.workplace import STEPS_PER_ITERATION, SingleThreadedRewardWorker, Workplace


def status_of(place: Workplace, id: str) -> tuple[str, str, str, int]:
    [row] = place.rows("SELECT status, phase, phase_detail, steps FROM experiments WHERE id = ?", id)
    return row


def drain(run) -> None:
    while run.step():
        pass


def first_version(place: Workplace, id: str) -> None:
    """Collect, ask, label, train: up to the first reward version."""
    reward = SingleThreadedRewardWorker(place.context)
    place.train(id)
    assert reward.work()
    place.label(id, 8)
    assert reward.work()


def test_first_rollout_gives_segments_and_then_waits_for_labels(place: Workplace):
    id = place.begin()
    with place.training(id) as run:
        drain(run)
        assert status_of(place, id) == (
            "running",
            "waiting_for_labels",
            "The first reward version is trained after 8 labels; 0 are in.",
            0,
        )
        [(count, length, iteration)] = place.rows(
            "SELECT count(*), max(length_steps), max(policy_iteration) FROM segments"
        )
        assert (count, length, iteration) == (8, 10, 0)
        assert not run.step()


def test_segments_are_stored_once_even_if_the_process_is_killed(place: Workplace):
    id = place.begin()
    for _ in range(2):
        place.train(id)
    assert place.rows("SELECT count(*) FROM segments") == [(8,)]


def test_each_iteration_names_the_reward_version_it_learned_from(place: Workplace):
    id = place.begin(label_budget=8)
    first_version(place, id)
    place.train(id)
    assert status_of(place, id)[0] == "finished"
    named = place.rows("SELECT DISTINCT reward_version_id FROM metrics WHERE name = 'learned_return'")
    assert named == place.rows("SELECT id FROM reward_versions")
    assert list(place.curve(id, "learned_return")) == [STEPS_PER_ITERATION * (n + 1) for n in range(6)]
    assert list(place.curve(id, "true_return_untrained")) == [0]
    assert list(place.curve(id, "true_return_final")) == [6 * STEPS_PER_ITERATION]


def test_policy_waits_until_due_labels_are_in_and_trained_on(place: Workplace):
    id = place.begin()
    first_version(place, id)
    with place.training(id) as run:
        drain(run)
        waiting = status_of(place, id)
        assert waiting[1] == "waiting_for_labels"
        assert waiting[3] < 6 * STEPS_PER_ITERATION
        reward = SingleThreadedRewardWorker(place.context)
        reward.work()
        place.label(id, 8)
        drain(run)
        assert "The reward model is being trained" in status_of(place, id)[2]
        assert reward.work()
        drain(run)
    assert status_of(place, id)[0] == "finished"
    used = [number for _, number in sorted(place.curve(id, "reward_version").items())]
    assert used == sorted(used)
    assert set(used) == {1.0, 2.0}


def test_an_interrupted_run_resumes_exactly(place: Workplace):
    """Killed before a checkpoint, left with one: the curves are those of an undisturbed run, bit for bit."""
    whole, broken = (place.begin(name, label_budget=8, seed=4) for name in ("whole", "broken"))
    # the same segments, queries and labels make the same first version
    for id in (whole, broken):
        first_version(place, id)
    place.train(whole)
    with place.training(broken) as run:
        for _ in range(2):
            run.step()
        run.save_progress()
        run.step()  # and no checkpoint of this one
    with place.training(broken) as run:
        assert run.step()
    place.train(broken)
    for name in ("learned_return", "policy_loss", "value_loss", "true_reward_correlation"):
        assert place.curve(whole, name) == place.curve(broken, name)
    assert place.curve(whole, "true_return_final") == place.curve(broken, "true_return_final")


def test_true_reward_asks_for_no_labels(place: Workplace):
    id = place.begin(reward_source="true")
    place.train(id)
    assert status_of(place, id)[0] == "finished"
    assert place.rows("SELECT count(*) FROM segments") == [(0,)]
    assert place.curve(id, "true_reward_correlation")[STEPS_PER_ITERATION] == pytest.approx(1.0)


def test_a_pause_takes_effect_between_iterations_after_a_checkpoint(place: Workplace):
    id = place.begin(reward_source="true")
    with place.training(id) as run:
        run.step()
        with place.database.transaction() as session:
            experiments.pause(session, id)
        assert not run.step()
        assert run.ended
        run.save_progress()
    assert place.rows("SELECT steps FROM policy_checkpoints") == [(STEPS_PER_ITERATION,)]
    with place.database.transaction() as session:
        experiments.resume(session, id)
    place.train(id)
    assert status_of(place, id)[0] == ExperimentStatus.FINISHED


def test_a_worker_without_the_claim_writes_nothing(place: Workplace):
    id = place.begin(reward_source="true")
    with place.training(id) as run:
        run.step()
        before = place.rows("SELECT count(*) FROM metrics")
        with place.database.transaction() as session:
            session.connection().exec_driver_sql("UPDATE claims SET holder = 'another'")
        with pytest.raises(ClaimLost):
            run.step()
        run.save_progress()
    assert place.rows("SELECT count(*) FROM metrics") == before
    assert place.rows("SELECT count(*) FROM policy_checkpoints") == [(0,)]
    assert place.rows("SELECT holder FROM claims") == [("another",)]


def test_settings_of_another_version_fail_the_experiment(place: Workplace):
    id = place.begin()
    with place.database.transaction() as session:
        row = experiments.get(session, id)
        row.config = {**row.config, "policy": {"n_environments": 4}}
    assert PolicyWorker(place.context).work()
    status, _, detail, _ = status_of(place, id)
    assert status == "failed"
    assert "n_environments" in detail


def test_the_policy_does_not_wait_when_every_pair_is_labelled(place: Workplace):
    # Four segments make six pairs, and more labels than that are due before there are others.
    id = place.begin(segment_steps=25, initial_labels=4, label_budget=40)
    reward = SingleThreadedRewardWorker(place.context)
    for _ in range(20):
        place.train(id)
        if status_of(place, id)[0] == "finished":
            break
        reward.work()
        [(open_queries,)] = place.rows("SELECT count(*) FROM queries WHERE status = 'open'")
        place.label(id, open_queries)
        reward.work()
    assert status_of(place, id)[0] == "finished"
    assert place.rows("SELECT label_count >= 36 FROM experiments") == [(1,)]


def test_too_few_pairs_for_the_first_labels_fail_the_experiment(place: Workplace):
    id = place.begin(segment_steps=25, initial_labels=7)
    place.train(id)
    assert SingleThreadedRewardWorker(place.context).work()
    place.label(id, 6)
    assert PolicyWorker(place.context).work()
    status, _, detail, _ = status_of(place, id)
    assert status == "failed"
    assert "initial_labels is 7" in detail


def test_while_one_waits_for_labels_another_is_trained(place: Workplace):
    waiting, ready = place.begin("waiting"), place.begin("ready", reward_source="true", total_steps=100)
    worker = PolicyWorker(place.context)
    for _ in range(2):
        assert worker.work()
    assert status_of(place, waiting)[1] == "waiting_for_labels"
    assert status_of(place, ready)[0] == "finished"


def test_work_returns_false_without_an_experiment(place: Workplace):
    assert not PolicyWorker(place.context).work()


def test_old_checkpoints_are_deleted_with_their_blobs(place: Workplace):
    id = place.begin(reward_source="true")
    with place.training(id) as run:
        for _ in range(5):
            run.step()
            run.save_progress()
    kept = {key for (key,) in place.rows("SELECT blob_key FROM policy_checkpoints")}
    there = {str(path.relative_to(place.home / "blobs")) for path in (place.home / "blobs" / "policies").rglob("*.*")}
    assert len(kept) == 3
    assert kept == there


@pytest.mark.parametrize(("model", "reward"), [("MAPT-CPA", "attended"), ("MA-Transformer", "weighted")])
def test_the_chosen_model_teaches_the_policy_by_the_chosen_reward(place: Workplace, model: str, reward: str):
    id = place.begin(label_budget=8, reward_model=model, policy_reward=reward, label_noise=0.1)
    first_version(place, id)
    place.train(id)
    assert status_of(place, id)[0] == "finished"
    [(blob_key,)] = place.rows("SELECT blob_key FROM reward_versions")
    trained = read_reward_model(place.context.blobs, blob_key)
    assert trained.config.architecture == ("mapt" if model == "MAPT-CPA" else "transformer")
    assert len(place.curve(id, "learned_return")) == 6
