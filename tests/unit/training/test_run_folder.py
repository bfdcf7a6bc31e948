"""Loading policies from the files of a learner, of `mapt train` and of the service."""

import pytest
import torch

from mapt.errors import CheckpointError, CheckpointMismatch, RunNotFound
from mapt.policies import Learner
from mapt.tasks import make_task
from mapt.training.policy_checkpoint import PolicyCheckpoint
from mapt.training.run_folder import load_policy
from support.short_tasks import SHORTEST_NAME
from support.training_runs import STEPS_PER_ITERATION


@pytest.fixture
def learner(settings):
    task = make_task(SHORTEST_NAME, 4)
    trained = Learner(task, settings().policy)
    rollout = trained.collect()
    trained.update(rollout, rollout.rewards)
    yield trained
    task.close()


def same_weights(learner: Learner, other) -> bool:
    first, second = learner.policy.state_dict(), other.policy.state_dict()
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def test_a_policy_loads_from_a_learners_file(learner, tmp_path):
    learner.save(tmp_path / "policy.safetensors")
    saved = load_policy(tmp_path / "policy.safetensors", "cpu")
    assert same_weights(learner, saved)
    assert (saved.task, saved.algorithm, saved.steps) == (SHORTEST_NAME, "mappo", STEPS_PER_ITERATION)


def test_a_policy_loads_from_a_checkpoint_of_the_service(learner, tmp_path):
    context = {"episode": torch.zeros(3).numpy()}
    (tmp_path / "000-ab.safetensors").write_bytes(PolicyCheckpoint(learner.to_bytes(), context).to_bytes())
    assert same_weights(learner, load_policy(tmp_path / "000-ab.safetensors", "cpu"))


def test_a_checkpoint_reads_back_as_it_was_written(learner):
    context = {"episode": torch.arange(3).numpy()}
    stored = PolicyCheckpoint.from_bytes(PolicyCheckpoint(learner.to_bytes(), context, {"iteration": 7}).to_bytes())
    assert stored.learner == learner.to_bytes()
    assert stored.context["episode"].tolist() == [0, 1, 2]
    assert stored.progress == {"iteration": 7}


def test_observations_of_other_dimensions_are_refused(learner, tmp_path):
    learner.save(tmp_path / "policy.safetensors")
    with pytest.raises(CheckpointMismatch):
        load_policy(tmp_path / "policy.safetensors", "cpu", agent_obsk=0)


def test_a_damaged_or_missing_policy_is_refused(learner, tmp_path):
    learner.save(tmp_path / "policy.safetensors")
    whole = (tmp_path / "policy.safetensors").read_bytes()
    for content in (b"", b"nothing", whole[:-8], whole[:100]):
        (tmp_path / "broken").write_bytes(content)
        with pytest.raises(CheckpointError):
            load_policy(tmp_path / "broken", "cpu")
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(RunNotFound):
            load_policy(path)
