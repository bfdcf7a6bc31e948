"""The penalty for states unlike those that a reward model learned from."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.rewards import novelty
from mapt.rewards.checkpoints import load_reward_model, save_reward_model
from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.model import MeanReward
from mapt.rewards.novelty import Novelty
from mapt.rewards.registry import build_reward_model
from mapt.rewards.relabelling import RewardStream, RolloutRelabeller
from mapt.rewards.trainer import train_reward_model
from support.tolerance import assert_float32_close

N_AGENTS, OBSERVATION_DIM, ACTION_DIM, N_ENVS = 2, 3, 1, 2
CONFIG = RewardConfig(OBSERVATION_DIM, ACTION_DIM, N_AGENTS, hidden_dim=16)
QUICK = TrainConfig(markov_epochs=1, max_epochs=1, device="cpu", novelty_weight=2.0)


@pytest.fixture(scope="module", autouse=True)
def short_training() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(novelty, "UPDATES", 300)
        yield


@pytest.fixture(scope="module")
def segments() -> SegmentArrays:
    """Segments whose observations lie near a curve, of which the last four steps of each are padding."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, size=(60, 20, N_AGENTS))
    observations = np.stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)), axis=-1)
    observations += 0.05 * rng.normal(size=observations.shape)
    observations[:, 16:] = 50.0
    mask = np.broadcast_to(np.arange(20) < 16, (60, 20))
    actions = rng.normal(size=(60, 20, N_AGENTS, ACTION_DIM))
    return SegmentArrays(observations.astype(np.float32), actions.astype(np.float32), mask.copy())


@pytest.fixture(scope="module")
def fitted(segments: SegmentArrays) -> Novelty:
    return Novelty.fitted(torch.as_tensor(segments.observations), torch.as_tensor(segments.mask), 2.0, seed=0)


@pytest.fixture(scope="module")
def dataset(segments: SegmentArrays) -> PreferenceDataset:
    pairs = np.arange(60).reshape(30, 2)
    return PreferenceDataset(segments, pairs, np.tile([0.0, 1.0], 15).astype(np.float32))


def test_states_of_the_segments_cost_nothing_and_others_do(segments: SegmentArrays, fitted: Novelty) -> None:
    known = fitted(torch.as_tensor(segments.observations[:, :16]))
    assert known.shape == (60, 16)
    assert (known == 0).float().mean() == pytest.approx(0.95, abs=0.01)
    inside = fitted(torch.zeros(1, N_AGENTS, OBSERVATION_DIM))
    far = fitted(torch.full((1, N_AGENTS, OBSERVATION_DIM), 3.0))
    assert 0 < inside.item() <= far.item()
    # It grows no further than to five times the weight, so that no state outweighs all others.
    assert far.item() == pytest.approx(10.0)


def test_padding_is_not_learned_from(fitted: Novelty) -> None:
    assert fitted(torch.full((1, N_AGENTS, OBSERVATION_DIM), 50.0)).item() == pytest.approx(10.0)


def test_a_known_state_of_another_agent_is_new() -> None:
    observations = torch.zeros(8, 10, 2, OBSERVATION_DIM)
    observations[:, :, 1] = 1.0
    observations += 0.01 * torch.randn(observations.shape, generator=torch.Generator().manual_seed(0))
    fitted = Novelty.fitted(observations, torch.ones(8, 10, dtype=torch.bool), 1.0, seed=0)
    assert fitted(observations).mean() < 0.1
    assert fitted(observations.flip(2)).mean() > 1.0


def test_training_adds_a_penalty_to_the_policys_rewards_and_changes_no_score(dataset: PreferenceDataset) -> None:
    plain = train_reward_model(dataset, CONFIG, replace(QUICK, novelty_weight=0.0)).model
    model = train_reward_model(dataset, CONFIG, QUICK).model
    assert plain.novelty is None
    assert model.novelty is not None
    inputs = [torch.as_tensor(array) for array in (dataset.segments.observations, dataset.segments.actions)]
    mask = torch.as_tensor(dataset.segments.mask)
    with torch.inference_mode():
        assert torch.equal(plain(*inputs, mask).score, model(*inputs, mask).score)
    rng = np.random.default_rng(1)
    observations = rng.normal(size=(9, N_ENVS, N_AGENTS, OBSERVATION_DIM)).astype(np.float32)
    actions = rng.normal(size=(9, N_ENVS, N_AGENTS, ACTION_DIM)).astype(np.float32)
    start = np.arange(9)[:, None] == np.array([0, 4])
    start[0] = True
    penalty = model.novelty(torch.as_tensor(observations)).numpy()
    assert penalty.max() > 0
    for credit in ("shared", "individual"):
        before, after = (
            RolloutRelabeller(each, 4, N_ENVS, credit).relabel(observations, actions, start) for each in (plain, model)
        )
        assert_float32_close(after, before - (penalty if credit == "shared" else penalty[..., None]))
        stream = RewardStream(model, 4, N_ENVS, credit)
        assert_float32_close(
            np.stack([stream.step(*step) for step in zip(observations, actions, start, strict=True)]), after
        )


def test_a_stop_ends_the_training_of_the_penalty_too(dataset: PreferenceDataset) -> None:
    calls = 0

    def stop(after: float = math.inf) -> bool:
        nonlocal calls
        calls += 1
        return calls > after

    train_reward_model(dataset, CONFIG, replace(QUICK, novelty_weight=0.0), stop=stop)
    without, calls = calls, 0
    trained = train_reward_model(dataset, CONFIG, QUICK, stop=lambda: stop(without + 5))
    assert trained.metrics["stopped"] == 1.0
    assert calls == without + 6


def test_a_further_version_learns_its_own_states(dataset: PreferenceDataset) -> None:
    first = train_reward_model(dataset, CONFIG, QUICK).model
    moved = replace(dataset.segments, observations=dataset.segments.observations + 5.0)
    second = train_reward_model(
        PreferenceDataset(moved, dataset.pairs, dataset.labels), CONFIG, QUICK, initial=first
    ).model
    assert first.novelty is not None
    assert second.novelty is not None
    states = torch.as_tensor(dataset.segments.observations[:, :16])
    assert first.novelty(states).mean() < 0.5 < second.novelty(states).mean()
    assert second.novelty(states + 5.0).mean() < 0.5


@pytest.mark.parametrize("networks", [1, 2])
def test_a_round_trip_gives_the_same_bits(fitted: Novelty, networks: int) -> None:
    built = [build_reward_model(CONFIG) for _ in range(networks)]
    model = MeanReward(built).eval() if networks > 1 else built[0].eval()
    model.novelty = fitted
    saved = save_reward_model(model, {})
    loaded = load_reward_model(saved.weights, saved.card).model
    assert loaded.novelty is not None
    states = torch.randn(7, N_AGENTS, OBSERVATION_DIM, generator=torch.Generator().manual_seed(0))
    assert torch.equal(loaded.novelty(states), fitted(states))
    assert save_reward_model(loaded, {}) == saved
    assert not any(parameter.requires_grad for parameter in loaded.novelty.parameters())
