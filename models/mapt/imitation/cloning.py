"""Behavioural cloning: the policy that makes the stored actions most likely."""

from typing import Protocol

import torch
from torch import Tensor, nn

from mapt.errors import TrainingDiverged
from mapt.imitation.config import CloningConfig
from mapt.imitation.demonstrations import Demonstrations
from mapt.policies import Policy, checkpoint
from mapt.policies.kernels import Adam, clip_grad_norm_

#: Adam's epsilon, torch's default.
ADAM_EPSILON = 1e-8


class OfflineTrainer(Protocol):
    """Trains a policy on stored steps, one gradient step per call."""

    def step(self) -> dict[str, Tensor]:
        """One gradient step of each network. Returns losses () by name."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that the next step depends on, except the policy and the data, as copies on the CPU."""
        ...

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore the result of `state_dict`. Raises CheckpointMismatch if it belongs to other settings."""
        ...


class CloningTrainer:
    """Maximises the likelihood of the stored actions. An `OfflineTrainer`.

    Args:
        policy: of any algorithm; its input statistics are fitted to the data.
        data: on the policy's device.
        seed: of the sampled batches.
    """

    def __init__(self, policy: Policy, data: Demonstrations, config: CloningConfig, seed: int) -> None:
        self._policy, self._data, self._config = policy, data, config
        self._generator = torch.Generator().manual_seed(seed)
        fit_normalisers(policy, data)
        self._optimiser = Adam(self._acting_parameters(), config.learning_rate, ADAM_EPSILON)

    def step(self) -> dict[str, Tensor]:
        """Raises TrainingDiverged if a gradient is not finite."""
        config = self._config
        observations, actions, available = self._data.sample_steps(config.batch, self._generator)
        loss = cloning_loss(self._policy, observations, actions, available)
        descend(loss, self._optimiser, config.max_gradient_norm)
        self._policy.limit_std(config.min_log_std)
        return {"cloning_loss": loss.detach()}

    def state_dict(self) -> dict[str, Tensor]:
        return checkpoint.flatten(
            {"optimiser": self._optimiser.state_dict(), "sampling": {"generator": self._generator.get_state()}}
        )

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        with checkpoint.refusing_mismatch():
            parts = checkpoint.unflatten(tensors)
            self._optimiser.load_state_dict(parts["optimiser"])
            self._generator.set_state(parts["sampling"]["generator"])

    def _acting_parameters(self) -> list[nn.Parameter]:
        """The parameters that actions depend on; MAT's actors share their encoder with the critic."""
        observations, actions, _ = self._data.sample_steps(1, torch.Generator().manual_seed(0))
        self._policy.zero_grad()
        cloning_loss(self._policy, observations, actions, None).backward()
        return [parameter for parameter in self._policy.parameters() if parameter.grad is not None]


def cloning_loss(policy: Policy, observations: Tensor, actions: Tensor, available: Tensor | None) -> Tensor:
    """Negative log-likelihood () of stored actions, in nats, mean over agents and steps.

    Args:
        observations: raw, (N, B, C).
        actions: (N, B, A).
        available: bool (N, B, A); None if all actions are available.
    """
    # The state is the input of the critic, whose values are not used.
    state = observations.new_zeros(observations.shape[1], policy.spec.state_dim)
    normalised, _ = policy.normalise(observations, state)
    log_probs, _, _ = policy.evaluate_actions(normalised, state, actions, available)
    return -log_probs.mean()


def fit_normalisers(policy: Policy, data: Demonstrations) -> None:
    """Add the stored observations to the policy's input statistics, unless it has some already."""
    if not any(bool(buffer > 0) for name, buffer in policy.named_buffers() if name.endswith("normaliser.count")):
        # Segments hold no state. One row of zeros is soon outweighed if the policy trains on in the task.
        policy.update_normalisers(data.observations, data.observations.new_zeros(1, policy.spec.state_dim))


def descend(loss: Tensor, optimiser: Adam, max_norm: float) -> None:
    """One gradient step on a loss (); raises as `take_step`."""
    optimiser.zero_grad()
    loss.backward()
    take_step(optimiser, max_norm)


def take_step(optimiser: Adam, max_norm: float) -> None:
    """Clip the gradients of a backward pass, or the sums of several, take a step by them and delete them.

    Raises:
        TrainingDiverged: if a gradient is not finite; the weights are then unchanged.
    """
    norm = clip_grad_norm_(optimiser.parameters, max_norm)
    if not torch.isfinite(norm):
        optimiser.zero_grad()
        raise TrainingDiverged(f"The norm of a gradient is {norm}. Lower the learning rate.")
    optimiser.step()
    optimiser.zero_grad()
