"""How good a policy is by the true reward: whole episodes with mean actions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mapt.policies import Policy, play
from mapt.tasks import make_task

#: the mean's standard error is then a sixth of the spread
EPISODES = 32
#: environments that play at once
_MOST_ENVS = 32
#: keeps the starts apart from those of training
SEED_OF_STARTS = 1_000_003


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Episodes of one policy."""

    #: true returns, and steps, by episode
    returns: tuple[float, ...]
    lengths: tuple[int, ...]

    def summary(self) -> dict[str, float]:
        """Mean, standard deviation and interquartile mean of the returns, their ends, and the mean length."""
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
        """The summary and every episode, for JSON."""
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
        """What `to_dict` gave; raises KeyError where something is missing."""
        return cls(tuple(map(float, values["returns"])), tuple(map(int, values["lengths"])))


def evaluate_policy(
    policy: Policy, task_name: str, *, agent_obsk: int, episodes: int = EPISODES, seed: int = 0, n_threads: int = 0
) -> Evaluation:
    """Play whole episodes with mean actions, from starts of their own.

    Args:
        seed: decides the starts.
        n_threads: as in `make_task`.
    """
    task = make_task(task_name, min(episodes, _MOST_ENVS), n_threads=n_threads, agent_obsk=agent_obsk)
    try:
        played = play(policy, task, episodes, seed=seed + SEED_OF_STARTS)
    finally:
        task.close()
    return Evaluation(tuple(played.returns.tolist()), tuple(played.lengths.tolist()))


def interquartile_mean(values: ArrayLike) -> float:
    """Mean of the middle half (Agarwal et al. 2021): a quarter of the values, rounded down, is left out at each end."""
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())
