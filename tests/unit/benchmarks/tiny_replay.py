"""A tiny replay whose true reward can be read off the observations, and models that know it or its opposite."""

from pathlib import Path

import numpy as np
from torch import Tensor, nn

from mapt.benchmarks.recorded_dataset import RecordedDataset
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.storage import SegmentLayout, SegmentWriter
from mapt.rewards.model import RewardOutput

N_SEGMENTS, N_STEPS, N_AGENTS, OBSERVATION_DIM = 80, 6, 2, 3
TASK = "Tiny"


def write_replay(path: Path, seed: int = 0, n_segments: int = N_SEGMENTS) -> RecordedDataset:
    """Reward of a step: the mean over agents of their first number."""
    rng = np.random.default_rng(seed)
    observations = rng.normal(size=(n_segments, N_STEPS, N_AGENTS, OBSERVATION_DIM)).astype(np.float32)
    actions = rng.normal(size=(n_segments, N_STEPS, N_AGENTS, 1)).astype(np.float32)
    layout = SegmentLayout(N_STEPS, N_AGENTS, OBSERVATION_DIM, 1, rewards=True)
    with SegmentWriter.create(path, layout, about={"task": TASK, "seed": seed}) as writer:
        whole = np.ones((n_segments, N_STEPS), np.bool_)
        writer.append(SegmentArrays(observations, actions, whole), rewards=observations[..., 0].mean(axis=2))
    return RecordedDataset.open(path)


class KnowingModel(nn.Module):
    """Gives each agent `sign` times the true reward, and each step the same weight."""

    def __init__(self, sign: float = 1.0) -> None:
        super().__init__()
        self.sign = sign

    def forward(self, observations: Tensor, actions: Tensor, mask: Tensor) -> RewardOutput:
        each = self.sign * observations[..., 0]
        weights = mask / mask.sum(dim=1, keepdim=True)
        rewards = each.mean(dim=2)
        return RewardOutput(each, rewards, weights, (weights * rewards).sum(dim=1))
