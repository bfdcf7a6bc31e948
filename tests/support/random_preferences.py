"""Pairs of random segments that an oracle labels, and settings with which reward models learn them in seconds."""

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.preferences.teachers import OracleTeacher, TeacherView
from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.mapt import MAPT

N_AGENTS, OBSERVATION_DIM, ACTION_DIM = 2, 4, 1
CONFIG = RewardConfig(OBSERVATION_DIM, ACTION_DIM, N_AGENTS, hidden_dim=16)
QUICK = TrainConfig(markov_epochs=8, max_epochs=3, device="cpu")


def preferences(
    n_pairs: int, n_steps: int = 8, seed: int = 0, labels: NDArray[np.floating] | None = None
) -> PreferenceDataset:
    """Random pairs. The oracle labels them by the mean over agents of the first observed number."""
    rng = np.random.default_rng(seed)
    shape = (2 * n_pairs, n_steps, N_AGENTS)
    observations = rng.normal(size=(*shape, OBSERVATION_DIM)).astype(np.float32)
    actions = rng.normal(size=(*shape, ACTION_DIM)).astype(np.float32)
    segments = SegmentArrays(observations, actions, np.ones(shape[:2], dtype=np.bool_))
    pairs = np.arange(2 * n_pairs).reshape(n_pairs, 2)
    rewards = observations[..., 0].mean(axis=2)
    if labels is None:
        labels = OracleTeacher().judge(TeacherView(rewards[pairs[:, 0]]), TeacherView(rewards[pairs[:, 1]]))
    return PreferenceDataset(segments, pairs, labels)


def same_weights(first: MAPT, second: MAPT) -> bool:
    return same_states(first.state_dict(), second.state_dict())


def same_states(first: Mapping[str, Tensor], second: Mapping[str, Tensor]) -> bool:
    return all(torch.equal(tensor, second[name]) for name, tensor in first.items())
