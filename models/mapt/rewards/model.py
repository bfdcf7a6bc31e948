"""The interface of all reward models, how rewards and step weights become a segment's score, and means of networks."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast

import torch
from torch import Tensor, nn

from mapt.errors import InvalidConfig, ModelMismatch, ShapeError
from mapt.rewards.config import RewardConfig
from mapt.rewards.layers import (
    InputNormaliser,
    LocalAttention,
    MarkovPath,
    RewardHead,
    drop_context,
    equal_weights,
    mean_attention,
    zero_init,
)
from mapt.rewards.novelty import Novelty

# Factor of every reward. The score of a whole segment is a mean over steps and agents, so it starts near 0, while the
# logit of a clear preference is about 5.
REWARD_GAIN = 10.0
# Smallest deviation by which rewards are divided, for models with a constant reward.
MIN_REWARD_DEVIATION = 1e-6

#: The policy's reward for the last step of a window; see `RewardModel.policy_rewards`.
PolicyReward = Literal["value", "attended", "weighted"]
#: Layers that read a normalised input, each with the column where it begins in the layer's input.
FirstLayers = Sequence[tuple[nn.Linear, int]]


@dataclass(frozen=True, slots=True)
class RewardOutput:
    """A reward model's outputs for S segments."""

    #: r-hat of each agent, float32 (S, T, N)
    agent_rewards: Tensor
    #: their mean over agents, (S, T)
    rewards: Tensor
    #: weight of each step, (S, T): 0 or more, 0 on padding, sum 1
    weights: Tensor
    #: see `RewardModel.score`, (S,); the logit of a preference is the difference of two scores
    score: Tensor


class RewardModel(nn.Module, ABC):
    """Rewards of N agents, learned from preferences between segments: a `RewardNetwork`, or the mean of several."""

    reward_mean: Tensor
    reward_deviation: Tensor

    def __init__(self, config: RewardConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("reward_mean", torch.zeros(()))
        self.register_buffer("reward_deviation", torch.ones(()))
        #: lowers the policy's reward where states are new; None without such a penalty
        self.novelty: Novelty | None = None

    @property
    @abstractmethod
    def networks(self) -> Sequence["RewardNetwork"]:
        """The networks whose mean it is; a network alone is its own mean."""

    @property
    def is_markov(self) -> bool:
        """Whether every reward depends on its step alone."""
        return all(network.is_markov for network in self.networks)

    @property
    def supports_local_attention(self) -> bool:
        """Whether r-hat depends on the window of a `LocalAttention` alone."""
        return all(network.supports_local_attention for network in self.networks)

    @abstractmethod
    def forward(self, observations: Tensor, actions: Tensor, mask: Tensor) -> RewardOutput:
        """Score segments.

        Args:
            observations: float32 (S, T, N, C).
            actions: float32 (S, T, N, A), one-hot where discrete.
            mask: bool (S, T), true where the step is real; real steps come first.

        Raises:
            ShapeError: if a shape does not fit the config.
        """

    @abstractmethod
    def agent_rewards(self, observations: Tensor, actions: Tensor, local: LocalAttention | None = None) -> Tensor:
        """r-hat of every step from its past, or from the part of it that `local` allows: (S, T, N) without the context.

        Raises:
            ShapeError: if a shape does not fit the config.
        """

    @abstractmethod
    def markov_rewards(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The Markov path's part of r-hat, (S, T, N); zero without such a path."""

    @abstractmethod
    def policy_rewards(
        self, observations: Tensor, actions: Tensor, mask: Tensor, kind: PolicyReward = "value"
    ) -> Tensor:
        """Each agent's reward for the last real step of windows, (S, N).

        - `value`: r-hat of that step.
        - `attended`: the output of the temporal attention at that step (paper, eq. 5, x_k of the last k): the mean of
          the window's r-hat under the last step's attention weights. This is the paper's inference taken literally.
        - `weighted`: r-hat of that step times its weight (eq. 6) times the number of real steps, so that equal weights
          give `value`.

        All are linear in r-hat, so that the mean over agents is the shared reward. The window is a segment of its own:
        its earlier steps see no further back than its first step. Shapes as in `forward`; `normalised` applies to all.

        Raises:
            ShapeError: if a shape does not fit the config.
        """

    def score(self, rewards: Tensor, weights: Tensor, mask: Tensor) -> Tensor:
        """Scores (S,) from rewards, weights and mask, each (S, T): T_real / T times the weighted mean of the rewards.

        T is `segment_steps` of the config. With equal weights, a score is proportional to the sum of the rewards, as
        teachers judge: a segment that ended early scores less than a whole one of equal rewards. With T = 0, it is the
        weighted mean.
        """
        mean = (weights * rewards).sum(dim=1)
        return mean * (mask.sum(dim=1) / self.config.segment_steps) if self.config.segment_steps else mean

    def agent_shares(self, agent_rewards: Tensor, weights: Tensor, mask: Tensor) -> Tensor:
        """The share of each agent in the `score`, (S, N), from individual rewards (S, T, N); the shares sum to it."""
        shares = (weights[..., None] * agent_rewards).sum(dim=1) / agent_rewards.shape[2]
        return shares * (mask.sum(dim=1) / self.config.segment_steps)[:, None] if self.config.segment_steps else shares

    def set_reward_scale(self, mean: float, deviation: float) -> None:
        """Set what `normalised` subtracts from rewards, and the deviation by which it divides them."""
        self.reward_mean.fill_(mean)
        self.reward_deviation.fill_(max(deviation, MIN_REWARD_DEVIATION))

    def normalised(self, rewards: Tensor) -> Tensor:
        """Rewards for the policy: of deviation 1, and of mean 0 unless trained with `subtract_mean=False`.

        Agents share one scale, so that the mean over agents is the shared reward's.
        """
        return (rewards - self.reward_mean) / self.reward_deviation

    def penalised(self, rewards: Tensor, observations: Tensor) -> Tensor:
        """What a policy trains on: `normalised` rewards less the penalty for new states, if the model has one.

        Args:
            rewards: of the team (...), or of each agent (..., N).
            observations: (..., N, C), before the steps.
        """
        rewards = self.normalised(rewards)
        if self.novelty is None:
            return rewards
        penalty = self.novelty(observations)
        return rewards - (penalty if rewards.dim() == penalty.dim() else penalty[..., None])


class RewardNetwork(RewardModel):
    """One network.

    A subclass defines `_encode`, the rewards from normalised inputs; `_first_layers`, the layers that read these
    inputs; and, where steps have different weights, `_step_attention`.
    """

    #: the path that sees the present step alone, if the network has one; it is trained first
    markov: MarkovPath | None

    def __init__(self, config: RewardConfig) -> None:
        super().__init__(config)
        self.observation_normaliser = InputNormaliser(config.observation_dim)
        self.action_normaliser = InputNormaliser(config.action_dim)

    @property
    def networks(self) -> Sequence["RewardNetwork"]:
        """Itself."""
        return (self,)

    @abstractmethod
    def _encode(self, inputs: tuple[Tensor, Tensor], local: LocalAttention | None) -> tuple[Tensor, Tensor]:
        """Features h and r-hat (S, T, N) of normalised inputs, both without the context of `local`.

        Args:
            inputs: observations (S, T, N, C) and actions (S, T, N, A).
        """

    @abstractmethod
    def _first_layers(self) -> tuple[FirstLayers, FirstLayers]:
        """The layers that read the normalised observations, and those that read the actions."""

    def _reward_readers(self) -> Sequence[nn.Linear]:
        """The layers that read r-hat."""
        return ()

    def _step_attention(self, h: Tensor, agent_rewards: Tensor, mask: Tensor) -> Tensor | None:
        """Attention weights over the real steps, (S, query step, key step), or None for equal weights."""
        return None

    def forward(self, observations: Tensor, actions: Tensor, mask: Tensor) -> RewardOutput:
        """See `RewardModel.forward`."""
        self._check(observations, actions, mask)
        h, agent_rewards = self._encode(self._normalise_inputs(observations, actions), None)
        rewards = agent_rewards.mean(dim=2)
        weights = _weights(self._step_attention(h, agent_rewards, mask), mask)
        return RewardOutput(agent_rewards, rewards, weights, self.score(rewards, weights, mask))

    def agent_rewards(self, observations: Tensor, actions: Tensor, local: LocalAttention | None = None) -> Tensor:
        """See `RewardModel.agent_rewards`."""
        self._check(observations, actions)
        # Skip the zero-initialised path when gradients are off: it contributes nothing.
        if self.is_markov and not torch.is_grad_enabled():
            return self.markov_rewards(drop_context(observations, local), drop_context(actions, local))
        return self._encode(self._normalise_inputs(observations, actions), local)[1]

    def markov_rewards(self, observations: Tensor, actions: Tensor) -> Tensor:
        """See `RewardModel.markov_rewards`."""
        return REWARD_GAIN * self._markov_output(self._normalise_inputs(observations, actions), None)

    def policy_rewards(
        self, observations: Tensor, actions: Tensor, mask: Tensor, kind: PolicyReward = "value"
    ) -> Tensor:
        """See `RewardModel.policy_rewards`."""
        self._check(observations, actions, mask)
        h, agent_rewards = self._encode(self._normalise_inputs(observations, actions), None)
        n_real = mask.sum(dim=1)
        last = torch.arange(len(mask), device=mask.device), n_real - 1
        if kind == "value":
            return agent_rewards[last]
        attention = self._step_attention(h, agent_rewards, mask)
        if kind == "attended":
            weights = equal_weights(mask) if attention is None else attention[last]
            return (weights[..., None] * agent_rewards).sum(dim=1)
        return (n_real * _weights(attention, mask)[last])[:, None] * agent_rewards[last]

    def fit_normalisers(self, observations: Tensor, actions: Tensor, mask: Tensor, *, keep_function: bool) -> None:
        """Set the input statistics from these segments (shapes as in `forward`).

        One-hot actions are normalised, too: few labels show that an action matters only if it varies as much as an
        observation (docs/results/benchmark-tasks.md).

        Args:
            keep_function: rescale the layers that read the inputs, so that the outputs do not change (except for
                inputs beyond the clip). For a trained model whose training continues on other states.
        """
        observation_layers, action_layers = self._first_layers() if keep_function else ((), ())
        self.observation_normaliser.fit(observations, mask, observation_layers)
        self.action_normaliser.fit(actions, mask, action_layers)

    def with_new_head(self) -> dict[str, Tensor]:
        """A copy of the model's weights with a re-initialised head beside a Markov path whose rewards are zero."""
        model = copy.deepcopy(self)
        for part in model.modules():
            if isinstance(part, RewardHead):
                part.reward.reset_parameters()
            elif isinstance(part, MarkovPath):
                zero_init(part.reward)
        return model.state_dict()

    def shrink_and_perturb(self, kept_fraction: float) -> dict[str, Tensor]:
        """A copy of the model's weights with those of the Markov path interpolated towards new initial weights.

        Args:
            kept_fraction: weight of the trained weights; the new ones have 1 - `kept_fraction`.

        Source: Ash and Adams (2020), "On Warm-Starting Neural Network Training".
        """
        model = copy.deepcopy(self)
        if (new := MarkovPath.of(self.config)) is not None and model.markov is not None:
            for parameter, fresh in zip(model.markov.parameters(), new.parameters(), strict=True):
                parameter.data.lerp_(fresh.data.to(parameter.device), 1 - kept_fraction)
        return model.state_dict()

    @torch.no_grad()
    def scale_rewards(self, factor: float) -> None:
        """Multiply r-hat, and with it every score, by a positive `factor`; the weights of the steps do not change."""
        for part in self.modules():
            if isinstance(part, (RewardHead, MarkovPath)):
                part.reward.weight.mul_(factor)
                part.reward.bias.mul_(factor)
        for layer in self._reward_readers():
            layer.weight.div_(factor)

    @property
    def is_markov(self) -> bool:
        """Whether r-hat is the Markov path's alone: no other path exists, or its head is still zero."""
        heads = [part.reward for part in self.modules() if isinstance(part, RewardHead)]
        return self.markov is not None and not any(
            parameter.any() for layer in heads for parameter in layer.parameters()
        )

    @property
    def supports_local_attention(self) -> bool:
        """Whether r-hat depends on the window of a `LocalAttention` alone.

        With a second layer or an LSTM, older steps influence the steps in the window.
        """
        config = self.config
        return self.is_markov or config.temporal == "none" or (config.temporal == "attention" and config.layers == 1)

    def _normalise_inputs(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        return self.observation_normaliser(observations), self.action_normaliser(actions)

    def _markov_output(self, inputs: tuple[Tensor, Tensor], local: LocalAttention | None) -> Tensor:
        observations, actions = (drop_context(part, local) for part in inputs)
        if self.markov is None:
            return observations.new_zeros(observations.shape[:3])
        return self.markov(torch.cat((observations, actions), dim=-1))

    def _markov_first_layers(self) -> tuple[FirstLayers, FirstLayers]:
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


class MeanReward(RewardModel):
    """The mean of the rewards and scores of several networks with the same config.

    Trained alike on 500 labels of a teacher of history, networks differ by several points of accuracy, and their mean
    is better than each of them: docs/results/reward-models.md, "The mean of networks".

    Raises:
        InvalidConfig: if there is no network.
        ModelMismatch: if their configs differ.
    """

    def __init__(self, networks: Sequence[RewardNetwork]) -> None:
        if not networks:
            raise InvalidConfig("The mean of networks needs at least one.", "networks")
        for network in networks:
            if network.config != networks[0].config:
                raise ModelMismatch("settings of a network", networks[0].config, network.config)
        super().__init__(networks[0].config)
        self.members = nn.ModuleList(networks)

    @property
    def networks(self) -> Sequence[RewardNetwork]:
        """See `RewardModel.networks`."""
        return cast("Sequence[RewardNetwork]", tuple(self.members))

    def forward(self, observations: Tensor, actions: Tensor, mask: Tensor) -> RewardOutput:
        """See `RewardModel.forward`.

        Scores and weights are the means of the networks'. So that they and the rewards fit together, the reward of a
        step is the mean of the networks' weighted by the weight that each gives the step.
        """
        outputs = [network(observations, actions, mask) for network in self.networks]
        weights = torch.stack([output.weights for output in outputs])
        agent_rewards = torch.stack([output.agent_rewards for output in outputs])
        shares = weights / weights.sum(dim=0).clamp(min=torch.finfo(weights.dtype).tiny)
        agent_rewards = (shares[..., None] * agent_rewards).sum(dim=0)
        score = torch.stack([output.score for output in outputs]).mean(dim=0)
        return RewardOutput(agent_rewards, agent_rewards.mean(dim=2), weights.mean(dim=0), score)

    def agent_rewards(self, observations: Tensor, actions: Tensor, local: LocalAttention | None = None) -> Tensor:
        """See `RewardModel.agent_rewards`; `local` must keep nothing from one call to the next."""
        return torch.stack([each.agent_rewards(observations, actions, local) for each in self.networks]).mean(dim=0)

    def markov_rewards(self, observations: Tensor, actions: Tensor) -> Tensor:
        """See `RewardModel.markov_rewards`."""
        return torch.stack([each.markov_rewards(observations, actions) for each in self.networks]).mean(dim=0)

    def policy_rewards(
        self, observations: Tensor, actions: Tensor, mask: Tensor, kind: PolicyReward = "value"
    ) -> Tensor:
        """See `RewardModel.policy_rewards`."""
        return torch.stack([each.policy_rewards(observations, actions, mask, kind) for each in self.networks]).mean(0)


def _weights(attention: Tensor | None, mask: Tensor) -> Tensor:
    return equal_weights(mask) if attention is None else mean_attention(attention, mask)
