"""MAGAIL: a policy that trains on the judgement of discriminators, which tell its steps from demonstrated ones.

Each agent has a discriminator of all agents' observations and its own action. They are critics of the Wasserstein
distance with a gradient penalty (Gulrajani et al. 2017, arXiv 1704.00028), and their outputs are the agents' rewards.
Source: Song, Ren, Sadigh and Ermon, "Multi-Agent Generative Adversarial Imitation Learning", NeurIPS 2018, arXiv
1807.09936.
"""

import math
from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mapt.device import torch_threads
from mapt.errors import TrainingDiverged
from mapt.imitation.cloning import CloningTrainer
from mapt.imitation.config import CloningConfig, MagailConfig
from mapt.imitation.demonstrations import Demonstrations
from mapt.policies import Policy, Rollout, checkpoint
from mapt.policies.networks import AgentLinear, initialise
from mapt.policies.normalisation import InputNormaliser
from mapt.rewards.model import RewardModel
from mapt.tasks import TaskSpec

#: Adam's decay rates in the training of the discriminators, as in Gulrajani et al.
BETAS = 0.5, 0.9


class Discriminators(nn.Module):
    """One perceptron per agent with three hidden layers, in one batched product per layer."""

    def __init__(self, spec: TaskSpec, hidden: int) -> None:
        super().__init__()
        n_agents = spec.n_agents
        self.normaliser = InputNormaliser(n_agents, 1, spec.observation_dim, samples_dim=1)
        sizes = (n_agents * spec.observation_dim + spec.action_dim, hidden, hidden, hidden)
        layers: list[nn.Module] = []
        for n_in, n_out in pairwise(sizes):
            layers += [AgentLinear(n_agents, n_in, n_out), nn.LeakyReLU(0.1)]
        self.network = nn.Sequential(*layers, AgentLinear(n_agents, hidden, 1))
        for layer in self.network:
            if isinstance(layer, AgentLinear):
                initialise(layer, math.sqrt(2))

    def inputs(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Inputs (N, B, N * C + A) of `forward`: each agent's own action beside all normalised observations.

        Args:
            observations: raw, (N, B, C).
            actions: (N, B, A).
        """
        n_agents, n_samples = observations.shape[:2]
        joint = self.normaliser(observations).transpose(0, 1).reshape(1, n_samples, -1)
        return torch.cat([joint.expand(n_agents, -1, -1), actions], -1)

    def forward(self, inputs: Tensor) -> Tensor:
        """Scores (N, B), high for demonstrated steps."""
        return self.network(inputs)[..., 0]


def gradient_penalty(score: Callable[[Tensor], Tensor], inputs: Tensor) -> Tensor:
    """(norm of the gradient of each score to its input - 1)^2, mean (N,) over samples.

    Args:
        score: scores (N, B) of inputs (N, B, D), each of its own input alone.
        inputs: (N, B, D).
    """
    inputs = inputs.detach().requires_grad_()
    (gradient,) = torch.autograd.grad(score(inputs).sum(), inputs, create_graph=True)
    return (gradient.norm(dim=-1) - 1.0).square().mean(-1)


def discriminator_loss(
    discriminators: Discriminators, policy: Tensor, demonstrated: Tensor, mix: Tensor, penalty_weight: float
) -> tuple[Tensor, Tensor]:
    """E[D(policy)] - E[D(demonstrated)] + weight * gradient penalty on points between both, and the distance E - E.

    Args:
        policy, demonstrated: inputs (N, B, D) of the discriminators.
        mix: uniform in [0, 1], (1, B, 1): position of the penalised points on the line between two inputs.

    Returns:
        Sum over agents () of the loss, and the mean over agents () of E[D(demonstrated)] - E[D(policy)].
    """
    both = discriminators(torch.cat([policy, demonstrated], 1))
    gap = both[:, policy.shape[1] :].mean(-1) - both[:, : policy.shape[1]].mean(-1)
    between = policy + mix * (demonstrated - policy)
    penalty = gradient_penalty(discriminators, between)
    return (penalty_weight * penalty - gap).sum(), gap.detach().mean()


def clone_first(policy: Policy, data: Demonstrations, config: MagailConfig, seed: int, n_threads: int = 1) -> None:
    """Start a new policy from behavioural cloning, for `config.cloning_steps` gradient steps."""
    if not config.cloning_steps:
        return
    trainer = CloningTrainer(policy, data, CloningConfig(), seed)
    with torch_threads(n_threads):
        for _ in range(config.cloning_steps):
            trainer.step()


class DiscriminatorReward:
    """Rewards (L, E, N) of rollouts by discriminators that learn from each rollout: a `RewardSource`.

    The discriminators are trained on a rollout before they reward it, so that one version rewards all of it. Their
    outputs have no meaningful zero: where episodes can terminate, a policy may prefer to end or to prolong them.

    Args:
        data: demonstrations, on `device`.
        seed: of the weights and the batches.
        context: as in the checkpoint that training resumes from.
    """

    #: Discriminators change with every rollout and have no version.
    version: str | None = None

    def __init__(
        self,
        data: Demonstrations,
        spec: TaskSpec,
        config: MagailConfig,
        *,
        seed: int,
        device: torch.device | str = "cpu",
        n_threads: int = 1,
        context: Mapping[str, NDArray[np.generic]] | None = None,
    ) -> None:
        self._data, self._config, self._device, self._n_threads = data, config, torch.device(device), n_threads
        self._generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.discriminators = Discriminators(spec, config.hidden).to(self._device)
        self.discriminators.normaliser.update(data.observations)
        self._optimiser = torch.optim.Adam(
            self.discriminators.parameters(), config.learning_rate, betas=BETAS, fused=self._device.type == "cuda"
        )
        self._metrics: dict[str, float] = {}
        if context:
            self._restore({name: torch.from_numpy(array) for name, array in context.items()})

    def set_version(self, version: str, load: Callable[[], RewardModel]) -> bool:
        """Ignores every version."""
        return False

    def rewards(self, rollout: Rollout) -> NDArray[np.floating]:
        """Train on the rollout, then reward it: (L, E, N).

        Raises:
            TrainingDiverged: if a gradient is not finite.
        """
        n_steps, n_envs = rollout.rewards.shape
        played = Demonstrations.from_rollout(rollout, self._device)
        with torch_threads(self._n_threads):
            gaps = [self.step(played) for _ in range(self._config.steps_per_rollout)]
            self._metrics = {"discriminator_gap": float(torch.stack(gaps).mean())}
            with torch.no_grad():
                scores = self.discriminators(self.discriminators.inputs(played.observations, played.actions))
        return scores.view(-1, n_envs, n_steps).permute(2, 1, 0).cpu().numpy()

    def step(self, played: Demonstrations) -> Tensor:
        """One gradient step on random demonstrated and played steps.

        Returns:
            E[D(demonstrated)] - E[D(played)] before the step, mean over agents, ().

        Raises:
            TrainingDiverged: if a gradient is not finite; the weights are then unchanged.
        """
        n, network = self._config.batch, self.discriminators
        demonstrated, policy = (
            network.inputs(*each.sample_steps(n, self._generator)[:2]) for each in (self._data, played)
        )
        mix = torch.rand(1, n, 1, generator=self._generator).to(self._device)
        loss, gap = discriminator_loss(network, policy, demonstrated, mix, self._config.gradient_penalty)
        self._optimiser.zero_grad()
        loss.backward()
        if not all(bool(torch.isfinite(each.grad).all()) for each in network.parameters() if each.grad is not None):
            raise TrainingDiverged("A gradient of a discriminator is not finite. Lower the learning rate.")
        self._optimiser.step()
        return gap

    def metrics(self) -> dict[str, float]:
        """`discriminator_gap` of the last rollout: how much higher demonstrated steps score than played ones."""
        return self._metrics

    def context(self) -> dict[str, NDArray[np.generic]]:
        """Everything that the next rewards depend on, for a checkpoint."""
        optimiser = {
            f"{index}.{name}": tensor
            for index, state in self._optimiser.state_dict()["state"].items()
            for name, tensor in state.items()
        }
        tensors = checkpoint.flatten(
            {
                "network": self.discriminators.state_dict(),
                "optimiser": optimiser,
                "sampling": {"generator": self._generator.get_state()},
            }
        )
        return {name: tensor.numpy() for name, tensor in tensors.items()}

    def _restore(self, tensors: dict[str, Tensor]) -> None:
        with checkpoint.refusing_mismatch():
            parts = checkpoint.unflatten(tensors)
            self.discriminators.load_state_dict(parts["network"])
            self._generator.set_state(parts["sampling"]["generator"])
            state: dict[int, dict[str, Tensor]] = {}
            for key, tensor in parts["optimiser"].items():
                index, _, name = key.partition(".")
                state.setdefault(int(index), {})[name] = tensor
            self._optimiser.load_state_dict({**self._optimiser.state_dict(), "state": state})
