"""Checkpoints: whole, free of pickle, and refused when they do not fit."""

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


def test_a_file_gives_the_learner_back(learner: Learner, tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    learner.save(path)
    loaded = Learner.load(path, IdentityTask(4))
    assert (loaded.config, loaded.steps) == (learner.config, learner.steps)
    expected = learner.state_dict()
    assert loaded.state_dict().keys() == expected.keys()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in loaded.state_dict().items())


def test_a_learner_that_has_not_learned_yet_can_be_saved() -> None:
    fresh = Learner(IdentityTask(4), CONFIG)
    loaded = Learner.from_bytes(fresh.to_bytes(), IdentityTask(4))
    assert torch.equal(torch.from_numpy(fresh.collect().actions), torch.from_numpy(loaded.collect().actions))


def test_saving_leaves_nothing_but_the_file(learner: Learner, tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    learner.save(path)
    learner.save(path)
    assert os.listdir(tmp_path) == [path.name]


def test_a_state_dict_does_not_change_with_the_learner(learner: Learner) -> None:
    state = learner.state_dict()
    kept = {name: tensor.clone() for name, tensor in state.items()}
    rollout = learner.collect()
    learner.update(rollout, rollout.rewards)
    assert all(torch.equal(tensor, kept[name]) for name, tensor in state.items())


@pytest.mark.parametrize("n_bytes", [0, 4, 100, -1])
def test_a_torn_file_is_refused(learner: Learner, n_bytes: int) -> None:
    with pytest.raises(DamagedCheckpoint):
        Learner.from_bytes(learner.to_bytes()[:n_bytes], IdentityTask(4))


def test_a_checkpoint_of_another_task_is_refused(learner: Learner) -> None:
    with pytest.raises(CheckpointMismatch, match="of Identity, not of HalfCheetah-6x1"):
        Learner.from_bytes(learner.to_bytes(), make_task("HalfCheetah-6x1", 4))


def test_a_checkpoint_of_a_later_format_is_refused(learner: Learner) -> None:
    later = pack(learner.state_dict(), {"format": 2, "task": "Identity", "config": CONFIG.to_dict()})
    with pytest.raises(NewerCheckpoint):
        Learner.from_bytes(later, IdentityTask(4))


@pytest.mark.parametrize("change", [{"hidden": (9,)}, {"shared_actor": True}, {"n_envs": 8}])
def test_tensors_of_another_configuration_are_refused(learner: Learner, change: dict) -> None:
    config = replace(CONFIG, **change)
    other = Learner(IdentityTask(config.n_envs), config)
    with pytest.raises(CheckpointMismatch, match="does not fit"):
        other.load_state_dict(learner.state_dict())
