"""The learner: collects a rollout, takes its rewards from the caller and updates the policy.

It never reads the task's own reward. The networks of the algorithms are in `networks` and `mat`, their gradient steps
in `ppo`.
"""

from collections.abc import Callable
from functools import partial
from math import ceil
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapt.device import resolve_device, seeded, torch_threads
from mapt.errors import InvalidConfig
from mapt.io import atomic_write
from mapt.policies import checkpoint
from mapt.policies.config import PolicyConfig, settings_for
from mapt.policies.mat import EncoderCritic, MultiAgentTransformer
from mapt.policies.networks import ActorCritic, Actors, Policy, StateCritic
from mapt.policies.normalisation import ValueRescaler
from mapt.policies.ppo import HAPPOUpdate, Metrics, PPOUpdate, Update, make_batch, raw_inputs, team_rewards
from mapt.policies.rollout import Collector, Rollout
from mapt.policies.slots import RemoteSlots, SlotCollector
from mapt.tasks import Task, TaskSpec

#: Fraction of the learning rate that is left when annealing ends.
FINAL_LEARNING_RATE = 0.1
#: An update whose KL divergence is off the target by more than the tolerance changes the learning rate by the step.
KL_TOLERANCE = 1.5
LEARNING_RATE_STEP = 1.2


def make_policy(spec: TaskSpec, config: PolicyConfig) -> Policy:
    """The networks of the configured algorithm, initialised from torch's global generator."""
    if config.algorithm == "mat":
        return MultiAgentTransformer(spec, config)
    actor = Actors(spec, config)
    return ActorCritic(spec, actor, (EncoderCritic if config.algorithm == "mat_dec" else StateCritic)(spec, config))


def untrained_policy(spec: TaskSpec, config: PolicyConfig) -> Policy:
    """The policy that training with these settings starts from; the seed determines its weights."""
    # The last bits of orthogonal weights depend on the number of threads; with one thread, machines agree.
    with seeded(config.seed, torch.device("cpu")), torch_threads(1):
        return make_policy(spec, config)


def make_update(policy: Policy, config: PolicyConfig) -> Update:
    """The update of the configured algorithm."""
    if isinstance(policy, ActorCritic) and config.algorithm == "happo":
        return HAPPOUpdate(policy, config)
    return PPOUpdate(policy, config)


class Learner:
    """Trains the policy of one task.

    Args:
        task: has `config.envs_per_collector` environments; is reset.
        config: settings.
        make_task: makes such a task in another process, for the collectors of a Ray cluster; picklable. None collects
            every rollout in this process.

    Raises:
        InvalidConfig: if the task has another number of environments, or the device does not exist.
    """

    def __init__(self, task: Task, config: PolicyConfig, make_task: Callable[[], Task] | None = None) -> None:
        if task.n_envs != config.envs_per_collector:
            slots = f" in {config.collectors} slots" if config.collectors else ""
            raise InvalidConfig(
                f"n_envs is {config.n_envs}{slots}, but the task has {task.n_envs} environments.", "n_envs"
            )
        self.task, self.config = task, config
        self.device = resolve_device(config.device)
        #: Environment steps collected so far.
        self.steps = 0
        self._generator = torch.Generator().manual_seed(config.seed)
        self._collector = Collector(task, config.seed) if config.collectors == 0 else self._slots(make_task)
        self._start()

    def _start(self) -> None:
        """Make what the updates change: networks, optimisers and statistics."""
        self.policy = untrained_policy(self.task.spec, self.config).to(self.device)
        self._update = make_update(self.policy, self.config)
        self._value_rescaler = ValueRescaler(self.task.spec.horizon_steps)
        #: Factor of the scheduled learning rate, at most 1, that keeps updates near `config.target_kl`.
        self._learning_rate_factor = 1.0

    def _slots(self, make_task: Callable[[], Task] | None) -> SlotCollector:
        remote = None
        if make_task is not None:
            make_policy = partial(untrained_policy, self.task.spec, self.config)
            remote = RemoteSlots(make_task, make_policy, self.config.n_threads)
        return SlotCollector(self.task, self.config.collectors, self.config.seed, remote)

    def start_from(self, content: bytes) -> None:
        """Take over the networks of another learner of this task. Call it before the first rollout.

        They come with their input statistics, and the critic with values that the first update rescales to the new
        rewards. Steps, optimisers and random numbers stay those of a new learner.

        Args:
            content: the other learner's `to_bytes`.

        Raises:
            CheckpointError: if it is damaged, or of another task or other networks.
        """
        tensors, stored = checkpoint.unpack(content, self.task.spec.name)
        with checkpoint.refusing_mismatch():
            # Some networks, such as those of another activation, have tensors of the same shapes.
            settings_for(self.task.spec, self.config.to_dict(), stored)
            parts = checkpoint.unflatten(tensors)
            checkpoint.load_networks(self.policy, parts)
            self._value_rescaler.load_state_dict(parts["learner"])
        self.reward_changed()

    def collect(self) -> Rollout:
        """Step the task `rollout_steps` times with the current policy, which starts anew if that is due."""
        if 0 < self.steps == self._restart_at:
            self._start()
        with torch_threads(self.config.n_threads):
            rollout = self._collector.collect(self.policy, self.config.rollout_steps, self._generator)
        self.steps += self.config.steps_per_rollout
        return rollout

    @property
    def _restart_at(self) -> int:
        """Steps before the first rollout of the new policy, a whole number of rollouts; 0 without a restart.

        Since steps alone decide, a learner that resumes from a checkpoint restarts exactly once too.
        """
        per_rollout = self.config.steps_per_rollout
        return ceil(self.config.restart_steps / per_rollout) * per_rollout

    @property
    def _policy_steps(self) -> int:
        """Environment steps since the policy started, or started anew."""
        return self.steps - self._restart_at if self.steps > self._restart_at else self.steps

    def reward_changed(self) -> None:
        """Announce that the next update's rewards come from another function than the last update's.

        The next update then rescales the critic's values (`ValueRescaler`). Without this call, PopArt adapts to the new
        rewards within about 1 / value_statistics_rate rollouts, and advantages are noisy until then.
        """
        self._value_rescaler.reward_changed()

    def update(self, rollout: Rollout, rewards: NDArray[np.floating]) -> dict[str, float]:
        """Improve the policy on a rollout.

        Args:
            rollout: the newest one from `collect`.
            rewards: (L, E), shared by the team, or (L, E, N), one per agent.

        Returns:
            Metrics by name; those of gradient steps are means over the last pass.

        Raises:
            InvalidRollout: if the rewards have another shape or are not finite.
            TrainingDiverged: if a gradient is not finite.
        """
        rewards = team_rewards(rewards, rollout)
        with torch_threads(self.config.n_threads):
            gamma = self.config.gamma_at(self._policy_steps)
            metrics = self._value_rescaler.update(rewards, rollout.terminated, self.policy.critic.statistics, gamma)
            batch, batch_metrics = make_batch(self.policy, rollout, rewards, self.config, gamma)
            learning_rate = self._set_learning_rate()
            step_metrics = averages(self._update.run(batch, self._generator))
            self._adapt_learning_rate(step_metrics["kl"])
            self.policy.limit_std(self.config.min_log_std)
            # Last, so that the rollout and its update use the same normalisation.
            self.policy.update_normalisers(*raw_inputs(self.policy, rollout))
        metrics |= batch_metrics | step_metrics | {"learning_rate": learning_rate}
        action_std = self.policy.action_std()
        return metrics if action_std is None else metrics | {"action_std": action_std}

    def _set_learning_rate(self) -> float:
        anneal_steps = self.config.anneal_steps
        progress = min(self._policy_steps / anneal_steps, 1.0) if anneal_steps else 0.0
        schedule = 1.0 - (1.0 - FINAL_LEARNING_RATE) * progress
        learning_rate = self.config.learning_rate * schedule * self._learning_rate_factor
        for optimiser in self._update.optimisers:
            optimiser.learning_rate = learning_rate
        return learning_rate

    def _adapt_learning_rate(self, kl: float) -> None:
        """Move the learning rate of the next update towards `target_kl`, as in rsl_rl (Rudin et al. 2022)."""
        target = self.config.target_kl
        if target and kl > target * KL_TOLERANCE:
            self._learning_rate_factor /= LEARNING_RATE_STEP
        elif target and kl < target / KL_TOLERANCE:
            self._learning_rate_factor = min(self._learning_rate_factor * LEARNING_RATE_STEP, 1.0)

    def state_dict(self) -> dict[str, Tensor]:
        """The complete state for an exact resume, as copies on the CPU; names are "part.name"."""
        parts = {name: network.state_dict() for name, network in self.policy.named_children()}
        own = {
            "steps": torch.tensor(self.steps),
            "generator": self._generator.get_state(),
            "learning_rate_factor": torch.tensor(self._learning_rate_factor, dtype=torch.float64),
        }
        return checkpoint.flatten(
            parts
            | {
                "optimiser": checkpoint.optimiser_state(self._update.optimisers),
                "collector": self._collector.state_dict(),
                "learner": own | self._value_rescaler.state_dict(),
            }
        )

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore the result of `state_dict`; on a CPU, training continues bit for bit.

        Raises:
            CheckpointMismatch: if it belongs to another task or configuration.
        """
        with checkpoint.refusing_mismatch():
            parts = checkpoint.unflatten(tensors)
            checkpoint.load_networks(self.policy, parts)
            checkpoint.load_optimiser_state(self._update.optimisers, parts.get("optimiser", {}))
            self._collector.load_state_dict(parts["collector"])
            own = parts["learner"]
            self._generator.set_state(own["generator"])
            self.steps = int(own["steps"])
            # Learners stored before there was a target for the KL divergence have no factor.
            self._learning_rate_factor = float(own.get("learning_rate_factor", 1.0))
            self._value_rescaler.load_state_dict(own)

    def to_bytes(self) -> bytes:
        """A checkpoint: `state_dict` and the configuration as one safetensors file."""
        return checkpoint.pack(self.state_dict(), {"task": self.task.spec.name, "config": self.config.to_dict()})

    @classmethod
    def from_bytes(cls, content: bytes, task: Task, make_task: Callable[[], Task] | None = None) -> Self:
        """The learner stored by `to_bytes`; see `Learner` for `make_task`.

        Raises:
            CheckpointError: if the checkpoint is damaged, or belongs to another task.
        """
        tensors, config = checkpoint.unpack(content, task.spec.name)
        learner = cls(task, PolicyConfig.from_dict(config), make_task)
        learner.load_state_dict(tensors)
        return learner

    def save(self, path: Path) -> None:
        """Write a checkpoint to a file; a crash leaves the old file or the new one."""
        atomic_write(path, self.to_bytes())

    @classmethod
    def load(cls, path: Path, task: Task) -> Self:
        """The learner stored by `save`; raises as `from_bytes` does."""
        return cls.from_bytes(path.read_bytes(), task)


def averages(steps: list[Metrics]) -> dict[str, float]:
    """Mean of each metric over the gradient steps that report it."""
    values = {name: [step[name] for step in steps if name in step] for step in steps for name in step}
    return {name: float(torch.stack(each).mean()) for name, each in values.items()}
