"""Action distributions of N agents: a Gaussian with independent dimensions, or a masked categorical.

Samples are a function of noise that is generated beforehand: one call of the learner's generator serves a whole
rollout and determines every sample.
"""

import math
from typing import Protocol

import torch
from torch import Tensor
from torch.distributions import OneHotCategorical

from mapt.tasks import TaskSpec

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)
#: Logit of an unavailable action. Its probability is exactly 0 in float32; with minus infinity, 0 * log(0) would turn
#: the entropy into NaN.
UNAVAILABLE = -1e10


class ActionDistribution(Protocol):
    """Distribution of actions (..., A); `...` are agents and environments."""

    def sample(self, noise: Tensor | None) -> Tensor:
        """Actions (..., A) from `action_noise` (..., A); without noise, the mean or the most likely action."""
        ...

    def log_prob(self, actions: Tensor) -> Tensor:
        """Log-probability or log-density (...) of actions (..., A), in nats."""
        ...

    def entropy(self) -> Tensor:
        """Mean entropy () over agents and environments, in nats."""
        ...


class Gaussian:
    """Normal distribution with independent dimensions.

    The density is written out: with `torch.distributions.Normal` a HAPPO run takes 5% longer, because it expands the
    standard deviations to every environment and takes the logarithm of their exponential.

    Args:
        mean: (..., A).
        log_std: logarithm of the standard deviations, broadcast against the mean.
        used: from `used_dimensions`; unused dimensions are 0 and do not contribute to probabilities.
    """

    def __init__(self, mean: Tensor, log_std: Tensor, used: Tensor | None = None) -> None:
        self.mean, self.log_std = mean, log_std
        self._used = used

    def sample(self, noise: Tensor | None) -> Tensor:
        return self._mask(self.mean if noise is None else self.mean + self.log_std.exp() * noise)

    def log_prob(self, actions: Tensor) -> Tensor:
        z = (actions - self.mean) * torch.exp(-self.log_std)
        return self._mask(-0.5 * z.square() - self.log_std - HALF_LOG_TWO_PI).sum(-1)

    def entropy(self) -> Tensor:
        return self._mask(self.log_std + 0.5 + HALF_LOG_TWO_PI).sum(-1).mean()

    def _mask(self, values: Tensor) -> Tensor:
        return values if self._used is None else values * self._used


class Categorical:
    """One of A actions, one-hot encoded.

    Args:
        logits: (..., A).
        available: bool, broadcast against the logits, at least one True per row: the actions that may be chosen.
        used: from `used_dimensions`: the actions that an agent has at all.
    """

    def __init__(self, logits: Tensor, available: Tensor | None = None, used: Tensor | None = None) -> None:
        for mask in (available, used):
            logits = logits if mask is None else logits.masked_fill(~mask, UNAVAILABLE)
        self._one_hot = OneHotCategorical(logits=logits, validate_args=False)

    def sample(self, noise: Tensor | None) -> Tensor:
        logits = self._one_hot.logits
        # The argmax of logits plus Gumbel noise is a sample of their softmax.
        chosen = (logits if noise is None else logits + noise).argmax(-1, keepdim=True)
        return torch.zeros_like(logits).scatter_(-1, chosen, 1.0)

    def log_prob(self, actions: Tensor) -> Tensor:
        return self._one_hot.log_prob(actions)

    def entropy(self) -> Tensor:
        return self._one_hot.entropy().mean()


def used_dimensions(spec: TaskSpec) -> Tensor | None:
    """Bool (N, 1, A): the action dimensions that each agent uses; None if all agents use all of them."""
    if all(dim == spec.action_dim for dim in spec.agent_action_dims):
        return None
    return (torch.arange(spec.action_dim) < torch.tensor(spec.agent_action_dims)[:, None])[:, None]


def mean_std(log_std: Tensor, used: Tensor | None) -> float:
    """Mean standard deviation over the used action dimensions."""
    std = log_std.detach().exp()
    return float((std if used is None else std[used]).mean())


def action_noise(spec: TaskSpec, batch_shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Noise (*batch_shape, A) for `sample`: standard normal, or standard Gumbel for discrete actions.

    Args:
        generator: on the CPU, so that the samples do not depend on the device of the networks.
    """
    shape = (*batch_shape, spec.action_dim)
    if not spec.discrete_actions:
        return torch.randn(shape, generator=generator)
    exponential = torch.empty(shape).exponential_(generator=generator)
    return -exponential.clamp_min_(torch.finfo(exponential.dtype).tiny).log_()
