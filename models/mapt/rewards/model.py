"""What every reward model shares: normalised inputs, a Markov path, and scores made of rewards and weights."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from mapt.errors import ShapeError
from mapt.rewards.config import RewardConfig
from mapt.rewards.kernels import Band, behind_context
from mapt.rewards.layers import InputNormaliser, MarkovPath, ReadOut, equal_weights, votes

# A score is a mean over steps and agents, so it starts near 0 and its logit must reach about 5 to be sure
# of a label. This factor on every reward spares the optimiser the way there.
REWARD_GAIN = 10.0
# A model that gives every step the same reward has deviation 0: it must not divide by it.
SMALLEST_REWARD_DEVIATION = 1e-6

#: What the policy is given for a window's last step; see `RewardModel.policy_rewards`.
PolicyReward = Literal["value", "attended", "weighted"]
#: Layers that read a normalised input, each with the column where its numbers begin there.
Readers = Sequence[tuple[nn.Linear, int]]


@dataclass(frozen=True, slots=True)
class RewardOutput:
    """What a reward model says of S segments."""

    #: r-hat of each agent, float32 (S, T, N)
    agent_rewards: Tensor
    #: their mean over agents, (S, T)
    rewards: Tensor
    #: how much each step counts, (S, T): at least 0, 0 on padding, sum 1
    weights: Tensor
    #: weighted sum of the rewards, (S,): the logit of a preference is a difference of two of these
    score: Tensor


class RewardModel(nn.Module, ABC):
    """Rewards of N agents that explain preferences between segments.

    An architecture says how rewards come from normalised inputs (`_encode`), which layers read those inputs
    (`_readers`), and, where steps do not all weigh the same, how much each asks of the others (`_shares`).
    """

    #: the path that sees the present step alone, where there is one; training may begin with it
    markov: MarkovPath | None
    reward_mean: Tensor
    reward_deviation: Tensor

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        self.config = config
        self.observation_normaliser = InputNormaliser(config.observation_dim)
        self.action_normaliser = InputNormaliser(config.action_dim)
        self.register_buffer("reward_mean", torch.zeros(()))
        self.register_buffer("reward_deviation", torch.ones(()))

    @abstractmethod
    def _encode(self, inputs: tuple[Tensor, Tensor], band: Band | None) -> tuple[Tensor, Tensor]:
        """Normalised observations (S, T, N, C) and actions (S, T, N, A) -> features h, and r-hat (S, T, N); both
        behind the context of a band."""

    @abstractmethod
    def _readers(self) -> tuple[Readers, Readers]:
        """The layers that read the normalised observations, and those that read the actions."""

    def awake_state(self) -> dict[str, Tensor]:
        """Its weights as they are, but for a read-out drawn anew: a path that sees the past and is not silent."""
        awake = copy.deepcopy(self)
        for part in awake.modules():
            if isinstance(part, ReadOut):
                part.reward.reset_parameters()
        return awake.state_dict()

    def softened_state(self, share: float) -> dict[str, Tensor]:
        """Its weights, but of those of the Markov path only `share` beside newly drawn ones."""
        softened = copy.deepcopy(self)
        if (drawn := MarkovPath.of(self.config)) is not None and softened.markov is not None:
            for parameter, new in zip(softened.markov.parameters(), drawn.parameters(), strict=True):
                parameter.data.lerp_(new.data.to(parameter.device), 1 - share)
        return softened.state_dict()

    def _shares(self, h: Tensor, agent_rewards: Tensor, mask: Tensor) -> Tensor | None:
        """How each step shares its vote among the real steps, (S, step that asks, step asked), or None: equally."""
        return None

    def forward(self, observations: Tensor, actions: Tensor, mask: Tensor) -> RewardOutput:
        """Score segments.

        Args:
            observations: float32 (S, T, N, C).
            actions: float32 (S, T, N, A), one-hot where discrete.
            mask: bool (S, T), true where the step is real; real steps come first.

        Raises:
            ShapeError: if a shape does not fit the configuration.
        """
        self._check(observations, actions, mask)
        h, agent_rewards = self._encode(self._normalised_inputs(observations, actions), None)
        rewards = agent_rewards.mean(dim=2)
        weights = _weights(self._shares(h, agent_rewards, mask), mask)
        return RewardOutput(agent_rewards, rewards, weights, (weights * rewards).sum(dim=1))

    def agent_rewards(self, observations: Tensor, actions: Tensor, band: Band | None = None) -> Tensor:
        """r-hat of every step from its past, as far back as `band` lets it see; (S, T, N), behind its context.

        Raises:
            ShapeError: if a shape does not fit the configuration.
        """
        self._check(observations, actions)
        # A silent path is spared, but where gradients are wanted: by them it wakes.
        if self.is_markov and not torch.is_grad_enabled():
            return self.markov_rewards(behind_context(observations, band), behind_context(actions, band))
        return self._encode(self._normalised_inputs(observations, actions), band)[1]

    def markov_rewards(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The Markov path's part of r-hat, (S, T, N); zero where there is no such path."""
        return REWARD_GAIN * self._markov(self._normalised_inputs(observations, actions), None)

    def policy_rewards(
        self, observations: Tensor, actions: Tensor, mask: Tensor, kind: PolicyReward = "value"
    ) -> Tensor:
        """What each agent is given for the last real step of windows, (S, N).

        - `value`: r-hat of that step.
        - `attended`: what the temporal preference attention puts out there (paper, eq. 5: x_k of the last k), a mean
          of the window's r-hat by the last step's attention. This is the paper's inference read to the letter.
        - `weighted`: r-hat of that step times its weight (eq. 6) times the number of real steps, so that
          equal weights leave `value`.

        All are linear in r-hat, so that the mean over agents is the shared reward. All are taken from the window as
        a segment of its own, in which the steps before the last see no further back than its first. `normalised`
        takes the scale of r-hat to all of them. Shapes as in `forward`.

        Raises:
            ShapeError: if a shape does not fit the configuration.
        """
        self._check(observations, actions, mask)
        h, agent_rewards = self._encode(self._normalised_inputs(observations, actions), None)
        n_real = mask.sum(dim=1)
        last = torch.arange(len(mask), device=mask.device), n_real - 1
        if kind == "value":
            return agent_rewards[last]
        shares = self._shares(h, agent_rewards, mask)
        if kind == "attended":
            share = equal_weights(mask) if shares is None else shares[last]
            return (share[..., None] * agent_rewards).sum(dim=1)
        return (n_real * _weights(shares, mask)[last])[:, None] * agent_rewards[last]

    def measure_inputs(self, observations: Tensor, actions: Tensor, mask: Tensor, *, keep_function: bool) -> None:
        """Take the input statistics from these segments (shapes as in `forward`).

        One-hot actions are left as they are: they have no unit to be rid of.

        Args:
            keep_function: re-express the layers that read the inputs in the new units. A model that goes on
                training as the policy's states move then loses nothing (but for inputs beyond the clip).
        """
        observation_readers, action_readers = self._readers() if keep_function else ((), ())
        self.observation_normaliser.measure(observations, mask, observation_readers)
        if not self.config.discrete_actions:
            self.action_normaliser.measure(actions, mask, action_readers)

    def set_reward_scale(self, mean: float, deviation: float) -> None:
        """Record mean and deviation of the shared reward, which `normalised` takes away."""
        self.reward_mean.fill_(mean)
        self.reward_deviation.fill_(max(deviation, SMALLEST_REWARD_DEVIATION))

    def normalised(self, rewards: Tensor) -> Tensor:
        """Rewards in units of the recorded deviation. Agents share one scale, so that the mean over them
        is the shared reward's."""
        return (rewards - self.reward_mean) / self.reward_deviation

    @property
    def is_markov(self) -> bool:
        """Whether r-hat is the Markov path's alone: there is no other, or it is as silent as it began."""
        read_outs = [part.reward for part in self.modules() if isinstance(part, ReadOut)]
        return self.markov is not None and not any(
            parameter.any() for layer in read_outs for parameter in layer.parameters()
        )

    @property
    def sees_one_window(self) -> bool:
        """Whether a `Band` bounds what r-hat depends on: with a second layer or an LSTM it does not, unless silent."""
        config = self.config
        return self.is_markov or config.temporal == "none" or (config.temporal == "attention" and config.layers == 1)

    def _normalised_inputs(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        return self.observation_normaliser(observations), self.action_normaliser(actions)

    def _markov(self, inputs: tuple[Tensor, Tensor], band: Band | None) -> Tensor:
        observed, acted = (behind_context(part, band) for part in inputs)
        if self.markov is None:
            return observed.new_zeros(observed.shape[:3])
        return self.markov(torch.cat((observed, acted), dim=-1))

    def _markov_readers(self) -> tuple[Readers, Readers]:
        if self.markov is None:
            return (), ()
        return ((self.markov.first, 0),), ((self.markov.first, self.config.observation_dim),)

    def _check(self, observations: Tensor, actions: Tensor, mask: Tensor | None = None) -> None:
        config = self.config
        expected = (config.n_agents, config.observation_dim)
        if observations.dim() != 4 or observations.shape[2:] != expected:
            raise ShapeError("observations", tuple(observations.shape), f"(S, T, {expected[0]}, {expected[1]})")
        expected = (*observations.shape[:3], config.action_dim)
        if actions.shape != expected:
            raise ShapeError("actions", tuple(actions.shape), f"{expected}")
        if mask is not None and mask.shape != observations.shape[:2]:
            raise ShapeError("mask", tuple(mask.shape), f"{tuple(observations.shape[:2])}")


def _weights(shares: Tensor | None, mask: Tensor) -> Tensor:
    return equal_weights(mask) if shares is None else votes(shares, mask)
