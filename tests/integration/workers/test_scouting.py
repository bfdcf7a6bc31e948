from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from accord.services import collect
from accord.store.blobs import FolderBlobs
from accord.store.tables import RewardVersionRow
from accord.workers.model_store import Ensembles
from accord.workers.query_planner import Scout
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.selection import segment_features
from mapt.rewards.config import RewardConfig
from mapt.rewards.ensemble import RewardEnsemble
from mapt.rewards.registry import build_reward_model
from support.scenes import ACTION, AGENTS, OBSERVATION, STEPS, segment
from support.tolerance import assert_float32_close

pytestmark = pytest.mark.numerics

CONFIG = RewardConfig(OBSERVATION, ACTION, AGENTS, hidden_dim=8, heads=2)


class CountedBlobs(FolderBlobs):
    """Counts how often each blob is read."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.reads: Counter[str] = Counter()

    def read(self, key: str) -> bytes:
        self.reads[key] += 1
        return super().read(key)


@pytest.fixture
def blobs(tmp_path: Path) -> CountedBlobs:
    return CountedBlobs(tmp_path)


def store(blobs: FolderBlobs, n_segments: int) -> tuple[list[str], SegmentArrays]:
    """Random segments: their blob keys, and themselves."""
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(n_segments, STEPS, AGENTS, OBSERVATION)).astype(np.float32)
    actions = rng.normal(size=(n_segments, STEPS, AGENTS, ACTION)).astype(np.float32)
    keys: list[str] = []
    for observed, acted in zip(observations, actions, strict=True):
        made = segment()
        whole = collect.NewSegment(observed, acted, made.rewards, made.qpos, made.qvel, 0, 0)
        keys.append(collect.store_arrays(blobs, "exp_1", whole).blob_key)
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
def torch_draws_as_before() -> Iterator[None]:
    with torch.random.fork_rng():
        yield


def test_scores_and_features_are_those_of_the_segments_in_their_order(blobs: CountedBlobs):
    keys, segments = store(blobs, 70)
    order = np.random.default_rng(1).permutation(70)
    wanted = [keys[place] for place in order]
    scout, ensemble = Scout(blobs), make_ensemble()
    scores = scout.scores("rwv_1", ensemble, wanted, "cpu")
    assert_float32_close(scores, ensemble.scores(segments)[:, order])
    assert scores.std() > 0.01
    assert_float32_close(scout.features(wanted), segment_features(segments)[order])


def test_a_segment_is_read_once_for_a_version_and_once_for_its_features(blobs: CountedBlobs):
    keys, _ = store(blobs, 6)
    scout, ensemble = Scout(blobs), make_ensemble()
    first = scout.scores("rwv_1", ensemble, keys[:4], "cpu")
    again = scout.scores("rwv_1", ensemble, keys, "cpu")
    assert np.array_equal(again[:, :4], first)
    assert set(blobs.reads.values()) == {1}
    other = scout.scores("rwv_2", make_ensemble(1), keys, "cpu")
    assert set(blobs.reads.values()) == {2}
    assert not np.allclose(other, again)
    # one segment of a pair may be in many pairs
    assert scout.features([keys[0], keys[1], keys[0]]).shape[0] == 3
    scout.features(keys)
    assert set(blobs.reads.values()) == {3}


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


def test_an_ensemble_is_written_once_and_read_by_whoever_comes_later(blobs: CountedBlobs):
    _, segments = store(blobs, 3)
    first, second = make_ensemble(0), make_ensemble(1)
    ensembles = Ensembles(blobs)
    assert not ensembles.has(version(1))
    assert ensembles.of(version(1)) is None
    ensembles.store(version(1), first)
    ensembles.store(version(1), second)
    for each in (ensembles, Ensembles(blobs)):
        assert each.has(version(1))
        kept = each.of(version(1))
        assert kept is not None
        assert np.array_equal(kept.scores(segments), first.scores(segments))
    assert ensembles.of(version(2)) is None


def test_only_the_latest_ensembles_stay_in_memory(blobs: CountedBlobs):
    ensembles = Ensembles(blobs)
    for number in range(6):
        ensembles.store(version(number), make_ensemble(number))
        ensembles.of(version(number))
    blobs.reads.clear()
    for number in (5, 4, 3, 2):
        ensembles.of(version(number))
    assert not blobs.reads
    assert ensembles.of(version(0)) is not None
    assert blobs.reads
