"""Evaluations as `mapt train`, `mapt evaluate` and `accord demo` report them: 32 episodes with mean actions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mapt.policies import Policy, play
from mapt.tasks import make_task

#: the standard error of the mean is then a sixth of the standard deviation
EPISODES = 32
#: maximum number of parallel environments
_MOST_ENVS = 32
#: added to the seed, so that initial states differ from those of training
SEED_OF_STARTS = 1_000_003


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The episodes of one evaluation."""

    #: true return and length in steps of each episode
    returns: tuple[float, ...]
    lengths: tuple[int, ...]

    def summary(self) -> dict[str, float]:
        """Mean, standard deviation, interquartile mean, minimum and maximum of the returns, and the mean length."""
        returns = np.asarray(self.returns)
        return {
            "mean": float(returns.mean()),
            "std": float(returns.std()),
            "iqm": interquartile_mean(returns),
            "min": float(returns.min()),
            "max": float(returns.max()),
            "length": float(np.mean(self.lengths)),
        }

    def to_dict(self) -> dict[str, object]:
        """The summary and every episode, ready for JSON."""
        return {
            "episodes": len(self.returns),
            **self.summary(),
            "returns": list(self.returns),
            "lengths": list(self.lengths),
        }

    def describe(self) -> str:
        """Mean, standard deviation and interquartile mean of the returns in one line."""
        found = self.summary()
        return (
            f"true return {found['mean']:,.1f} ± {found['std']:,.1f} (interquartile mean {found['iqm']:,.1f}) "
            f"over {len(self.returns)} episodes of {found['length']:,.0f} steps"
        )

    @classmethod
    def from_dict(cls, values: Mapping[str, Sequence[float]]) -> "Evaluation":
        """Read the result of `to_dict`. Raises KeyError if a key is missing."""
        return cls(tuple(map(float, values["returns"])), tuple(map(int, values["lengths"])))


def evaluate_policy(
    policy: Policy, task_name: str, *, agent_obsk: int, episodes: int = EPISODES, seed: int = 0, n_threads: int = 0
) -> Evaluation:
    """Play whole episodes with mean actions.

    Args:
        seed: seed of the initial states.
        n_threads: as in `make_task`.
    """
    task = make_task(task_name, min(episodes, _MOST_ENVS), n_threads=n_threads, agent_obsk=agent_obsk)
    try:
        played = play(policy, task, episodes, seed=seed + SEED_OF_STARTS)
    finally:
        task.close()
    return Evaluation(tuple(played.returns.tolist()), tuple(played.lengths.tolist()))


def interquartile_mean(values: ArrayLike) -> float:
    """Mean without the lowest and the highest quarter of the values, each rounded down (Agarwal et al. 2021)."""
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())
