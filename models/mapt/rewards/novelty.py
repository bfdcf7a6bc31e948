"""A penalty for states unlike those that a reward model learned from.

Where no segment shows a state, the networks of a reward model guess, and they guess alike, so that their disagreement
does not tell. A policy that trains on a fixed reward model meets such states and is paid for them at random.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from mapt.device import seeded
from mapt.rewards.layers import InputNormaliser

#: share of the training steps whose error is below the threshold of the penalty
_TYPICAL_SHARE = 0.95
#: multiple of the threshold up to which the penalty grows: beyond, errors say nothing about distance
_MAX_EXCESS = 5.0
_WIDTH, _FEATURES = 64, 32
#: gradient steps of the predictor
UPDATES = 3000
_BATCH_STEPS, _LEARNING_RATE = 256, 1e-3


class Novelty(nn.Module):
    """Random network distillation: a network predicts the features of a fixed, random one, and errs on new states.

    Source: Burda et al. (2019), "Exploration by Random Network Distillation", which pays for the errors; here they
    cost. Each agent's observation is judged beside the agent's number, and a state by the mean error over the agents.

    Args:
        weight: standard deviations of the policy's reward that a state costs whose error is twice the threshold.
    """

    weight: Tensor
    threshold: Tensor

    def __init__(self, n_agents: int, observation_dim: int, weight: float = 0.0) -> None:
        super().__init__()
        self._n_agents = n_agents
        self.normaliser = InputNormaliser(observation_dim)
        self.target, self.predictor = (_features(observation_dim + n_agents) for _ in range(2))
        self.register_buffer("weight", torch.tensor(weight))
        self.register_buffer("threshold", torch.ones(()))

    def forward(self, observations: Tensor) -> Tensor:
        """The penalty of states, from observations (..., N, C): (...), 0 for most states of the training segments."""
        excess = self._errors(observations) / self.threshold - 1.0
        return self.weight * excess.clamp(0.0, _MAX_EXCESS)

    def _errors(self, observations: Tensor) -> Tensor:
        inputs = self.normaliser(observations)
        agents = torch.eye(self._n_agents, device=inputs.device).expand(*inputs.shape[:-1], self._n_agents)
        inputs = torch.cat((inputs, agents), dim=-1)
        return (self.predictor(inputs) - self.target(inputs)).square().mean(dim=(-2, -1))

    @classmethod
    def fitted(
        cls, observations: Tensor, mask: Tensor, weight: float, seed: int, stop: Callable[[], bool] = lambda: False
    ) -> "Novelty":
        """Trained on the real steps of segments.

        Args:
            observations: float32 (S, T, N, C).
            mask: bool (S, T), true where the step is real.
            seed: of the initial weights and the batches.
            stop: called before every gradient step; true ends the training.
        """
        device = observations.device
        with seeded(seed, device):
            novelty = cls(observations.shape[2], observations.shape[3], weight).to(device)
            novelty.normaliser.fit(observations, mask, ())
            states = observations[mask]
            novelty.target.requires_grad_(False)
            optimiser = torch.optim.Adam(novelty.predictor.parameters(), _LEARNING_RATE)
            for _ in range(UPDATES):
                if stop():
                    break
                batch = torch.randint(len(states), (_BATCH_STEPS,)).to(device)
                loss = novelty._errors(states[batch]).mean()
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
        with torch.no_grad():
            errors = torch.cat([novelty._errors(part) for part in states.split(_BATCH_STEPS)])
            # Unlike `torch.quantile`, `kthvalue` takes any number of errors. Equal states may have none.
            typical = errors.kthvalue(max(1, round(_TYPICAL_SHARE * len(errors)))).values
            novelty.threshold.copy_(typical.clamp(min=torch.finfo(errors.dtype).tiny))
        return novelty.requires_grad_(False).eval()


def _features(n_inputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(n_inputs, _WIDTH), nn.GELU(), nn.Linear(_WIDTH, _WIDTH), nn.GELU(), nn.Linear(_WIDTH, _FEATURES)
    )
