"""A reward of the present step alone."""

import torch.nn.functional as F
from torch import Tensor, nn

from mapt.rewards.config import RewardConfig
from mapt.rewards.scalar import ScalarLinear


class MarkovPath(nn.Module):
    """A reward of each agent's present step alone: (S, T, N, C + A) -> (S, T, N)."""

    def __init__(self, dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.first = nn.Linear(dim, hidden_dim)
        self.second = nn.Linear(hidden_dim, hidden_dim)
        self.reward = ScalarLinear(hidden_dim)

    @classmethod
    def of(cls, config: RewardConfig) -> "MarkovPath | None":
        """The path of a network of these settings, if it has one."""
        if not config.markov_path:
            return None
        return cls(config.observation_dim + config.action_dim, config.markov_dim or config.hidden_dim)

    def forward(self, inputs: Tensor) -> Tensor:
        return self.reward(F.gelu(self.second(F.gelu(self.first(inputs))))).squeeze(-1)
