"""Checkpoints: exact resume, earlier formats, and errors for files that are damaged or do not fit."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from learning.identity_task import IdentityTask
from mapt.errors import CheckpointMismatch, DamagedCheckpoint, NewerCheckpoint
from mapt.policies import Learner, PolicyConfig
from mapt.policies.checkpoint import pack
from mapt.tasks import make_task

CONFIG = PolicyConfig(n_envs=4, rollout_steps=8, minibatches=1, epochs=2, hidden=(8,), device="cpu")


@pytest.fixture
def learner() -> Learner:
    trained = Learner(IdentityTask(4), CONFIG)
    rollout = trained.collect()
    trained.update(rollout, rollout.rewards)
    return trained


def test_file_restores_the_learner(learner: Learner, tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    learner.save(path)
    loaded = Learner.load(path, IdentityTask(4))
    assert (loaded.config, loaded.steps) == (learner.config, learner.steps)
    expected = learner.state_dict()
    assert loaded.state_dict().keys() == expected.keys()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in loaded.state_dict().items())


def test_untrained_learner_can_be_saved() -> None:
    fresh = Learner(IdentityTask(4), CONFIG)
    loaded = Learner.from_bytes(fresh.to_bytes(), IdentityTask(4))
    assert torch.equal(torch.from_numpy(fresh.collect().actions), torch.from_numpy(loaded.collect().actions))


def test_saving_leaves_no_other_file(learner: Learner, tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    learner.save(path)
    learner.save(path)
    assert os.listdir(tmp_path) == [path.name]


def test_state_dict_is_a_copy(learner: Learner) -> None:
    state = learner.state_dict()
    before = {name: tensor.clone() for name, tensor in state.items()}
    rollout = learner.collect()
    learner.update(rollout, rollout.rewards)
    assert all(torch.equal(tensor, before[name]) for name, tensor in state.items())


@pytest.mark.parametrize("n_bytes", [0, 4, 100, -1])
def test_truncated_file_is_damaged(learner: Learner, n_bytes: int) -> None:
    with pytest.raises(DamagedCheckpoint):
        Learner.from_bytes(learner.to_bytes()[:n_bytes], IdentityTask(4))


def test_checkpoint_of_another_task_does_not_match(learner: Learner) -> None:
    with pytest.raises(CheckpointMismatch):
        Learner.from_bytes(learner.to_bytes(), make_task("HalfCheetah-6x1", 4))


def test_checkpoint_of_a_later_format_is_newer(learner: Learner) -> None:
    later = pack(learner.state_dict(), {"format": 3, "task": "Identity", "config": CONFIG.to_dict()})
    with pytest.raises(NewerCheckpoint):
        Learner.from_bytes(later, IdentityTask(4))


@pytest.mark.parametrize("change", [{"hidden": (9,)}, {"shared_actor": True}, {"n_envs": 8}])
def test_tensors_of_another_configuration_do_not_match(learner: Learner, change: dict) -> None:
    config = replace(CONFIG, **change)
    other = Learner(IdentityTask(config.n_envs), config)
    with pytest.raises(CheckpointMismatch):
        other.load_state_dict(learner.state_dict())


FORMAT_1_NAMES = {
    "query_norm": "seen_norm",
    "context_norm": "done_norm",
    "self_attention": "among_actions",
    "cross_attention": "from_seen",
}


def format_1_name(name: str) -> str:
    """Name in format 1 of a tensor of MAT's decoder."""
    part, *rest = name.split(".")
    if part != "decoder" or rest == ["log_std"]:
        return name
    return ".".join(["decoder", "network", *(FORMAT_1_NAMES.get(each, each) for each in rest)])


def test_checkpoint_of_format_1_is_loaded() -> None:
    config = replace(CONFIG, algorithm="mat", width=8)
    trained = Learner(IdentityTask(4), config)
    rollout = trained.collect()
    trained.update(rollout, rollout.rewards)
    expected = trained.state_dict()
    old = {format_1_name(name): tensor for name, tensor in expected.items()}
    assert "decoder.network.layers.0.among_actions.query.weight" in old
    content = pack(old, {"format": 1, "task": "Identity", "config": config.to_dict()})
    loaded = Learner.from_bytes(content, IdentityTask(4)).state_dict()
    assert loaded.keys() == expected.keys()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in loaded.items())


def test_a_new_learner_can_start_from_the_networks_of_a_checkpoint(learner: Learner) -> None:
    started = Learner(IdentityTask(4), replace(CONFIG, seed=1, learning_rate=1e-4))
    started.start_from(learner.to_bytes())
    assert started.steps == 0
    assert started.config.learning_rate == 1e-4
    found, stored = started.state_dict(), learner.state_dict()
    networks = [name for name in found if name.startswith(("actor.", "critic."))]
    assert networks
    assert all(torch.equal(found[name], stored[name]) for name in networks)
    assert not any(torch.any(tensor) for name, tensor in found.items() if name.startswith("optimiser."))


def test_values_of_a_policy_that_starts_from_a_checkpoint_are_rescaled_to_its_first_rewards(learner: Learner) -> None:
    started = Learner(IdentityTask(4), CONFIG)
    started.start_from(learner.to_bytes())
    before = started.policy.critic.statistics.std.clone()
    rollout = started.collect()
    started.update(rollout, 100.0 * rollout.rewards)
    assert torch.all(started.policy.critic.statistics.std > 10.0 * before)


@pytest.mark.parametrize("change", [{"hidden": (9,)}, {"activation": "relu"}, {"algorithm": "happo"}])
def test_a_learner_of_other_networks_cannot_start_from_a_checkpoint(learner: Learner, change: dict) -> None:
    [name] = change
    with pytest.raises(CheckpointMismatch, match=f"{name} is .* but the policy to start from has .* Leave {name} out"):
        Learner(IdentityTask(4), replace(CONFIG, **change)).start_from(learner.to_bytes())


def test_a_learner_of_another_task_cannot_start_from_a_checkpoint(learner: Learner) -> None:
    with pytest.raises(CheckpointMismatch, match="of task Identity, not HalfCheetah-6x1"):
        Learner(make_task("HalfCheetah-6x1", 4), CONFIG).start_from(learner.to_bytes())
