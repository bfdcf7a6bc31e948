"""The learner: one iteration is `collect`, rewards from whoever gives them, `update`.

It never reads a task's own reward. What an algorithm is made of lies beside it: its networks (`actor_critic`, `mat`)
behind `Policy`, and how they are moved (`updates`) behind `Update`.
"""

import math
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapt.errors import InvalidConfig, TrainingDiverged
from mapt.io import atomic_write
from mapt.policies import checkpoint
from mapt.policies.config import PolicyConfig
from mapt.policies.device import resolve_device, torch_threads
from mapt.policies.kernels import Adam
from mapt.policies.mat import EncoderCritic, MultiAgentTransformer
from mapt.policies.networks import ActorCritic, Actors, Policy, StateCritic
from mapt.policies.normalisation import RewardUnits
from mapt.policies.ppo import checked_rewards, inputs, make_update, prepare
from mapt.policies.rollout import Collector, Rollout
from mapt.tasks import Task, TaskSpec

#: Fraction of the learning rate that is left when annealing ends.
FINAL_LEARNING_RATE = 0.1


def make_policy(spec: TaskSpec, config: PolicyConfig) -> Policy:
    """The networks of the configured algorithm, drawn by torch's global generator."""
    if config.algorithm == "mat":
        return MultiAgentTransformer(spec, config)
    actor = Actors(spec, config)
    return ActorCritic(spec, actor, (EncoderCritic if config.algorithm == "mat_dec" else StateCritic)(spec, config))


class Learner:
    """Trains the policy of one task.

    Args:
        task: with `config.n_envs` environments; reset here with `config.seed`.
        config: settings.

    Raises:
        InvalidConfig: if the task has another number of environments, or no such device is there.
    """

    def __init__(self, task: Task, config: PolicyConfig) -> None:
        if task.n_envs != config.n_envs:
            raise InvalidConfig(f"The task has {task.n_envs} environments, the configuration {config.n_envs}.")
        self.task, self.config = task, config
        self.device = resolve_device(config.device)
        #: Environment steps collected so far.
        self.steps = 0
        self._generator = torch.Generator().manual_seed(config.seed)
        # Orthogonal weights depend in their last bits on how many threads make them, and no run should on the machine's
        # number of cores.
        with torch.random.fork_rng(devices=[]), torch_threads(1):
            torch.manual_seed(config.seed)
            self.policy = make_policy(task.spec, config).to(self.device)
        self._update = make_update(self.policy, config)
        self._optimiser = Adam(self._update.groups, config.learning_rate, config.max_gradient_norm)
        self._collector = Collector(task, config.seed)
        self._reward_units = RewardUnits(config, task.spec.horizon_steps)

    def collect(self) -> Rollout:
        """Step the task `rollout_steps` times with the policy as it is."""
        with torch_threads(self.config.n_threads):
            rollout = self._collector.collect(self.policy, self.config.rollout_steps, self._generator)
        self.steps += self.config.steps_per_rollout
        return rollout

    def reward_changed(self) -> None:
        """Say that the next update's rewards come from another function than the last one's; see `RewardUnits`.

        Without the call nothing breaks: the critic's units follow within some 1 / value_statistics_rate rollouts, with
        noisy advantages meanwhile.
        """
        self._reward_units.changed()

    def update(self, rollout: Rollout, rewards: NDArray[np.floating]) -> dict[str, float]:
        """Improve the policy on a rollout.

        Args:
            rollout: the newest one of `collect`.
            rewards: (L, E), shared by the team, or (L, E, N), each agent's own.

        Returns:
            Metrics by name, those of gradient steps as means over the last pass.

        Raises:
            InvalidRollout: if the shape is another or a number is not finite.
            TrainingDiverged: if a gradient is not finite.
        """
        each = checked_rewards(rewards, rollout)
        with torch_threads(self.config.n_threads):
            metrics = self._reward_units.follow(each, self.policy.critic.statistics)
            batch, of_batch = prepare(self.policy, rollout, each, self.config)
            rate = self._set_learning_rate()
            steps = self._update.run(batch, self._gradient_step, self._generator)
            # Statistics of inputs change last, so that collecting and learning saw the same ones.
            self.policy.absorb_inputs(*inputs(self.policy, rollout))
        metrics |= of_batch | averages(steps) | {"learning_rate": rate}
        spread = self.policy.action_std()
        return metrics if spread is None else metrics | {"action_std": spread}

    def _gradient_step(self, loss: Tensor, group: int = 0) -> Tensor:
        gradients, norm = self._optimiser.gradients(loss, group)
        if not math.isfinite(norm):
            raise TrainingDiverged(f"The gradient's norm became {norm.item()} after {self.steps} steps.")
        self._optimiser.step(gradients, group)
        return norm

    def _set_learning_rate(self) -> float:
        anneal = self.config.anneal_steps
        done = min(self.steps / anneal, 1.0) if anneal else 0.0
        rate = self.config.learning_rate * (1.0 - (1.0 - FINAL_LEARNING_RATE) * done)
        self._optimiser.learning_rate = rate
        return rate

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides the future, flat, as copies on the CPU."""
        networks = {name: network.state_dict() for name, network in self.policy.named_children()}
        own = {"steps": torch.tensor(self.steps), "generator": self._generator.get_state()}
        parts = networks | {
            "optimiser": self._optimiser.state_dict(),
            "collector": self._collector.state_dict(),
            "learner": own | self._reward_units.state_dict(),
        }
        return checkpoint.flatten(parts)

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Continue exactly, bit for bit on a CPU, as the learner that gave `state_dict` would have.

        Raises:
            CheckpointError: if it belongs to another task or configuration.
        """
        with checkpoint.refusing_mismatch():
            parts = checkpoint.unflatten(tensors)
            for name, network in self.policy.named_children():
                network.load_state_dict(parts[name])
            self._optimiser.load_state_dict(parts.get("optimiser", {}))
            self._collector.load_state_dict(parts["collector"])
            own = parts["learner"]
            self._generator.set_state(own["generator"])
            self.steps = int(own["steps"])
            self._reward_units.load_state_dict(own)

    def to_bytes(self) -> bytes:
        """A checkpoint: `state_dict` and the configuration as one safetensors file."""
        return checkpoint.pack(self.state_dict(), {"task": self.task.spec.name, "config": self.config.to_dict()})

    @classmethod
    def from_bytes(cls, content: bytes, task: Task) -> Self:
        """The learner that `to_bytes` wrote.

        Raises:
            CheckpointError: if it is damaged, or belongs to another task.
        """
        tensors, config = checkpoint.unpack(content, task.spec.name)
        learner = cls(task, PolicyConfig.from_dict(config))
        learner.load_state_dict(tensors)
        return learner

    def save(self, path: Path) -> None:
        """Write `to_bytes` to a file; a crash leaves the old file or the new one, whole."""
        atomic_write(path, self.to_bytes())

    @classmethod
    def load(cls, path: Path, task: Task) -> Self:
        """The learner that `save` wrote; raises as `from_bytes` does."""
        return cls.from_bytes(path.read_bytes(), task)


def averages(steps: list[dict[str, Tensor]]) -> dict[str, float]:
    """Mean of each metric over the gradient steps that tell it."""
    told = {name: [step[name] for step in steps if name in step] for step in steps for name in step}
    return {name: float(torch.stack(values).mean()) for name, values in told.items()}
