"""Preferences over the replay of a team that learns HalfCheetah-6x1, and how well a reward model explains them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from mapt.policies import MappoConfig, MappoLearner, Rollout, train, true_reward
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.preferences.teachers import Evidence, OracleTeacher
from mapt.rewards.config import RewardConfig
from mapt.rewards.metrics import correlation, rank_correlation
from mapt.rewards.network import MAPT
from mapt.tasks import make_task

TASK, SEGMENT_STEPS = "HalfCheetah-6x1", 50
ENVS_KEPT = 6
N_TEST_SEGMENTS, N_TEST_PAIRS = 800, 2000

#: From the true rewards (B, T) of both segments to labels (B,).
Judge = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class Replay:
    """Segments from a training with the true reward, in the order they were made."""

    segments: SegmentArrays
    #: float64 (S, T)
    rewards: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Quality:
    """A reward model on segments it was not trained on; `late` is the last fifth of the replay."""

    #: of fresh pairs
    accuracy: float
    #: of predicted score and true return
    rank_correlation: float
    rank_correlation_late: float
    #: of r-hat_t and the true reward, over all steps of late segments
    step_correlation_late: float
    #: the same after taking each segment's mean away from both
    step_correlation_within: float

    def __str__(self) -> str:
        return (
            f"accuracy {self.accuracy:.3f}, rank {self.rank_correlation:.3f}, late {self.rank_correlation_late:.3f}; "
            f"steps {self.step_correlation_late:.3f}, within segments {self.step_correlation_within:.3f}"
        )


def oracle(rewards_0: NDArray[np.float64], rewards_1: NDArray[np.float64]) -> NDArray[np.float32]:
    """The larger return is better."""
    return OracleTeacher().judge(Evidence(rewards_0), Evidence(rewards_1))


def record_replay(total_steps: int, seed: int) -> Replay:
    """Train with the true reward, keeping some segments of every rollout."""
    config = MappoConfig(seed=seed, device="cpu")
    task = make_task(TASK, config.n_envs)
    parts: list[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]] = []

    def keep(_learner: MappoLearner, rollout: Rollout, _metrics: dict[str, float]) -> None:
        for first in range(0, config.rollout_steps - SEGMENT_STEPS + 1, SEGMENT_STEPS):
            steps = slice(first, first + SEGMENT_STEPS)
            for env in range(ENVS_KEPT):
                if not rollout.episode_start[steps, env][1:].any():
                    parts.append(
                        (rollout.observations[steps, env], rollout.actions[steps, env], rollout.rewards[steps, env])
                    )

    train(MappoLearner(task, config), true_reward, total_steps, keep)
    task.close()
    observations, actions, rewards = zip(*parts, strict=True)
    return Replay(SegmentArrays.stack(observations, actions), np.stack(rewards))


def split_replay(replay: Replay, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of segments to learn from and of segments to test on, each in the order they were made."""
    order = np.random.default_rng([seed, 0]).permutation(len(replay.segments))
    return np.sort(order[N_TEST_SEGMENTS:]), np.sort(order[:N_TEST_SEGMENTS])


def labelled_pairs(replay: Replay, n_pairs: int, seed: int, judge: Judge = oracle) -> PreferenceDataset:
    """Pairs drawn uniformly from the segments to learn from."""
    pool, _ = split_replay(replay, seed)
    pairs = random_pairs(pool, n_pairs, np.random.default_rng([seed, 1]))
    used, positions = np.unique(pairs, return_inverse=True)
    labels = judge(replay.rewards[pairs[:, 0]], replay.rewards[pairs[:, 1]])
    return PreferenceDataset(replay.segments.take(used), positions.reshape(-1, 2), labels)


def random_pairs(pool: NDArray[np.int64], n_pairs: int, rng: np.random.Generator) -> NDArray[np.int64]:
    return np.stack([rng.choice(pool, 2, replace=False) for _ in range(n_pairs)])


def measure(model: MAPT, replay: Replay, seed: int, judge: Judge = oracle) -> Quality:
    """Quality on the test segments of `split_replay`."""
    _, test = split_replay(replay, seed)
    segments = replay.segments.take(test)
    with torch.inference_mode():
        output = model(*(torch.as_tensor(x) for x in (segments.observations, segments.actions, segments.mask)))
    score, learned, true = output.score.numpy(), output.rewards.numpy(), replay.rewards[test]
    pairs = random_pairs(np.arange(len(test)), N_TEST_PAIRS, np.random.default_rng([seed, 2]))
    labels = judge(true[pairs[:, 0]], true[pairs[:, 1]])
    late = slice(len(test) * 4 // 5, None)
    centred = [steps[late] - steps[late].mean(axis=1, keepdims=True) for steps in (learned, true)]
    return Quality(
        float(((score[pairs[:, 0]] > score[pairs[:, 1]]) == (labels == 1)).mean()),
        rank_correlation(score, true.sum(axis=1)),
        rank_correlation(score[late], true[late].sum(axis=1)),
        correlation(learned[late].ravel(), true[late].ravel()),
        correlation(centred[0].ravel(), centred[1].ravel()),
    )


def small_config(replay: Replay) -> RewardConfig:
    segments = replay.segments
    return RewardConfig.preset(
        "small",
        observation_dim=segments.observation_dim,
        action_dim=segments.action_dim,
        n_agents=segments.n_agents,
    )


def markov_config(replay: Replay) -> RewardConfig:
    """A Markov MLP for each agent: the same network without attention or past."""
    return replace(small_config(replay), temporal="none", agent_attention=False, cpa=False, tpa=False)
