"""Train in a loop of your own, on a reward that was learned from comparisons: Gymnasium's swimmer as one agent.

python docs/examples/gymnasium_loop.py [comparisons] [iterations]
"""

import sys

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.wrappers import ReshapeObservation, TransformAction

from mapt.preferences import PreferenceDataset, SegmentArrays
from mapt.rewards import LearnedVectorReward, RewardConfig, TrainConfig, train_reward_model

N, C, A = 1, 8, 2
ENVS, STEPS, ELITES = 32, 50, 6
rng = np.random.default_rng(0)


def swimmer() -> gymnasium.Env:
    """One environment whose observations (N, C) and actions (N, A) have an axis of agents."""
    env = ReshapeObservation(gymnasium.make("Swimmer-v5"), (N, C))
    return TransformAction(env, lambda action: action[0], Box(-1, 1, (N, A)))


def play(env: VectorEnv, weights: np.ndarray) -> list[np.ndarray]:
    """Observations, actions, rewards and true rewards (E, T, ...) of the linear policies `weights` (E, C, A)."""
    observation, _ = env.reset(seed=0)
    steps = []
    for _ in range(STEPS):
        action = np.tanh(observation @ weights).astype(np.float32)
        following, reward, _, _, info = env.step(action)
        steps.append((observation, action, reward, info.get("true_reward", reward)))
        observation = following
    return [np.stack(each, axis=1) for each in zip(*steps, strict=True)]


def main(comparisons: int = 300, iterations: int = 15) -> None:
    swimmers = SyncVectorEnv([swimmer] * ENVS)
    # Random policies, and a teacher who prefers the segment that came further. Ask a person here instead.
    played = [play(swimmers, rng.standard_normal((ENVS, C, A))) for _ in range(10)]
    observations, actions, distances = (np.concatenate(each) for each in list(zip(*played, strict=True))[:3])
    pairs = np.array([rng.choice(len(observations), 2, replace=False) for _ in range(comparisons)])
    returns = distances.sum(axis=1)[pairs]
    labels = (returns[:, 0] > returns[:, 1]).astype(np.float32)
    segments = SegmentArrays(observations.astype(np.float32), actions, np.ones((len(actions), STEPS), dtype=bool))
    config = RewardConfig.named("MA-MLP", observation_dim=C, action_dim=A, n_agents=N, segment_steps=STEPS)
    trained = train_reward_model(PreferenceDataset(segments, pairs, labels), config, TrainConfig())
    print(f"{trained.metrics['holdout_accuracy']:.0%} of the held-out comparisons predicted")

    # The cross-entropy method sees the learned reward only.
    env = LearnedVectorReward(swimmers, trained.model, window=STEPS)
    mean, deviation = np.zeros((C, A)), np.ones((C, A))
    for iteration in range(iterations):
        candidates = mean + deviation * rng.standard_normal((ENVS, C, A))
        _, _, learned, true = play(env, candidates)
        best = np.argsort(learned.sum(axis=1))[-ELITES:]
        mean, deviation = candidates[best].mean(axis=0), candidates[best].std(axis=0) + 0.02
        print(f"iteration {iteration + 1}: mean true return {true.sum(axis=1).mean():.1f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]))
