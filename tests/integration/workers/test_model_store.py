from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from accord.services import collect
from accord.store.blobs import FolderBlobs
from accord.store.tables import RewardVersionRow
from accord.workers.model_store import EnsembleStore
from mapt.preferences.dataset import SegmentArrays
from mapt.rewards.config import RewardConfig
from mapt.rewards.ensemble import RewardEnsemble
from mapt.rewards.registry import build_reward_model
from support.sample_experiments import ACTION, AGENTS, OBSERVATION, STEPS, segment

CONFIG = RewardConfig(OBSERVATION, ACTION, AGENTS, hidden_dim=8, heads=2)


@pytest.fixture
def blobs(tmp_path: Path) -> FolderBlobs:
    return FolderBlobs(tmp_path)


def store(blobs: FolderBlobs, n_segments: int) -> tuple[list[str], SegmentArrays]:
    """Store random segments; return their blob keys and arrays."""
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(n_segments, STEPS, AGENTS, OBSERVATION)).astype(np.float32)
    actions = rng.normal(size=(n_segments, STEPS, AGENTS, ACTION)).astype(np.float32)
    keys: list[str] = []
    for observed, acted in zip(observations, actions, strict=True):
        example = segment()
        stored = collect.NewSegment(observed, acted, example.rewards, example.qpos, example.qvel, 0, 0)
        keys.append(collect.store_arrays(blobs, "exp_1", stored).blob_key)
    return keys, SegmentArrays(observations, actions, np.ones((n_segments, STEPS), dtype=np.bool_))


def make_ensemble(seed: int = 0, members: int = 2) -> RewardEnsemble:
    torch.manual_seed(seed)
    models = [build_reward_model(CONFIG) for _ in range(members)]
    for model in models:
        # An untrained model gives every step the same reward.
        for parameter in model.parameters():
            torch.nn.init.normal_(parameter)
    return RewardEnsemble(models)


@pytest.fixture(autouse=True)
def restore_the_torch_random_state() -> Iterator[None]:
    with torch.random.fork_rng():
        yield


def version(number: int) -> RewardVersionRow:
    return RewardVersionRow(
        id=f"rwv_{number}",
        experiment_id="exp_1",
        number=number,
        parent_id=None,
        label_watermark=1,
        label_count=1,
        policy_steps=0,
        blob_key=f"rewards/exp_1/rwb_{number}.safetensors",
        metrics={},
    )


def test_a_stored_ensemble_is_never_overwritten(blobs: FolderBlobs):
    _, segments = store(blobs, 3)
    first, second = make_ensemble(0), make_ensemble(1)
    ensembles = EnsembleStore(blobs)
    assert not ensembles.has(version(1))
    assert ensembles.load(version(1)) is None
    ensembles.store(version(1), first)
    ensembles.store(version(1), second)
    for opened_store in (ensembles, EnsembleStore(blobs)):
        assert opened_store.has(version(1))
        loaded = opened_store.load(version(1))
        assert loaded is not None
        assert np.array_equal(loaded.scores(segments), first.scores(segments))
    assert ensembles.load(version(2)) is None
