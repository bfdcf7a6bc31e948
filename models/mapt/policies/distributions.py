"""How actions are drawn, and how likely they were: Gaussian numbers, or one choice of several.

Both are drawn from noise that is made beforehand, so that one call draws for a whole rollout and a seed decides it.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from mapt.tasks import TaskSpec

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)
#: Logit of a choice that is not available. Its probability is exactly 0 in float32, and 0 times it is still 0, which
#: minus infinity would turn into NaN in the entropy.
UNAVAILABLE = -1e10


class ActionDistribution(Protocol):
    """Distribution of the actions of some agents in some environments; `...` are those dimensions."""

    def choose(self, noise: Tensor | None) -> Tensor:
        """Actions (..., A), from `action_noise`; the likeliest without it."""
        ...

    def draw(self, noise: Tensor | None) -> tuple[Tensor, Tensor]:
        """What `choose` gives, and the log-probabilities (...) of it."""
        ...

    def log_probs(self, actions: Tensor) -> Tensor:
        """Log-probability or log-density (...) of actions (..., A)."""
        ...

    def entropy(self) -> Tensor:
        """Mean over everything of the actions' entropy (), in nats."""
        ...


@dataclass(frozen=True, slots=True)
class Gaussian:
    """Independent normal numbers.

    Args:
        mean: (..., A).
        log_std: log of the standard deviations, broadcast against the mean.
        used: of `used_numbers`; the others are 0 and count for nothing.
    """

    mean: Tensor
    log_std: Tensor
    used: Tensor | None = None

    def choose(self, noise: Tensor | None) -> Tensor:
        return self._of_used(self.mean if noise is None else self.mean + self.log_std.exp() * noise)

    def draw(self, noise: Tensor | None) -> tuple[Tensor, Tensor]:
        return self.choose(noise), self._log_density(torch.zeros_like(self.mean) if noise is None else noise)

    def log_probs(self, actions: Tensor) -> Tensor:
        return self._log_density((actions - self.mean) * torch.exp(-self.log_std))

    def entropy(self) -> Tensor:
        return self._of_used(self.log_std + 0.5 + HALF_LOG_TWO_PI).sum(-1).mean()

    def _log_density(self, noise: Tensor) -> Tensor:
        return self._of_used(-0.5 * noise.square() - self.log_std - HALF_LOG_TWO_PI).sum(-1)

    def _of_used(self, numbers: Tensor) -> Tensor:
        return numbers if self.used is None else numbers * self.used


@dataclass(frozen=True, slots=True)
class Categorical:
    """One of A choices, written as one-hot.

    Args:
        logits: (..., A), with `UNAVAILABLE` where a choice cannot be made; see `masked`.
    """

    logits: Tensor

    @classmethod
    def masked(cls, logits: Tensor, *masks: Tensor | None) -> "Categorical":
        """Of the choices that every mask allows, bool (..., A), at least one each; no mask allows all."""
        for mask in masks:
            logits = logits if mask is None else logits.masked_fill(~mask, UNAVAILABLE)
        return cls(logits)

    def choose(self, noise: Tensor | None) -> Tensor:
        # The largest of logits plus Gumbel noise is a draw from their softmax.
        chosen = (self.logits if noise is None else self.logits + noise).argmax(-1, keepdim=True)
        return torch.zeros_like(self.logits).scatter_(-1, chosen, 1.0)

    def draw(self, noise: Tensor | None) -> tuple[Tensor, Tensor]:
        actions = self.choose(noise)
        return actions, self.log_probs(actions)

    def log_probs(self, actions: Tensor) -> Tensor:
        return self.logits.log_softmax(-1).gather(-1, actions.argmax(-1, keepdim=True)).squeeze(-1)

    def entropy(self) -> Tensor:
        log_probs = self.logits.log_softmax(-1)
        return -(log_probs.exp() * log_probs).sum(-1).mean()


def used_numbers(spec: TaskSpec) -> Tensor | None:
    """Bool (N, 1, A): which numbers of its action each agent uses; nothing if all use all."""
    if all(dim == spec.action_dim for dim in spec.agent_action_dims):
        return None
    return (torch.arange(spec.action_dim) < torch.tensor(spec.agent_action_dims)[:, None])[:, None]


def mean_std(log_std: Tensor, used: Tensor | None) -> float:
    """Mean standard deviation of the numbers that are used."""
    std = log_std.detach().exp()
    return float((std if used is None else std[used]).mean())


def action_noise(spec: TaskSpec, lead: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """What `draw` turns into actions: standard normal, or standard Gumbel if actions are discrete.

    Args:
        spec: of the task.
        lead: leading dimensions of the result (*lead, A).
        generator: on the CPU, so that the draws are the same wherever the networks live.
    """
    shape = (*lead, spec.action_dim)
    if not spec.discrete_actions:
        return torch.randn(shape, generator=generator)
    waits = torch.empty(shape).exponential_(generator=generator)
    return -waits.clamp_min_(torch.finfo(waits.dtype).tiny).log_()
