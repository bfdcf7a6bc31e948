"""MAPPO (Yu et al. 2022): decentralised Gaussian actors, a central critic, PPO's clipped objective.

One iteration is `collect`, rewards from whoever gives them, `update`. The learner never reads a task's own reward.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from mapt.policies import checkpoint
from mapt.policies.config import MappoConfig
from mapt.policies.errors import InvalidConfig, InvalidRewards, TrainingDiverged
from mapt.policies.gae import advantages
from mapt.policies.networks import Actor, Critic
from mapt.policies.rollout import Collector, Rollout
from mapt.tasks import Task

#: Adam's epsilon as PPO's reference code has it: gradients of normalised losses are small.
ADAM_EPSILON = 1e-5
#: Fraction of the learning rate that is left when annealing ends.
FINAL_LEARNING_RATE = 0.1


@dataclass(frozen=True, slots=True)
class _Batch:
    """A rollout as the update reads it, B = L * E samples."""

    #: (N, B, C) normalised; (N, B, A); (N, B); (N, B).
    observations: Tensor
    actions: Tensor
    log_probs: Tensor
    advantages: Tensor
    #: (B, S) normalised; (B, N) in the critic's units.
    state: Tensor
    returns: Tensor

    def pick(self, index: Tensor) -> "_Batch":
        return _Batch(
            self.observations.index_select(1, index),
            self.actions.index_select(1, index),
            self.log_probs.index_select(1, index),
            self.advantages.index_select(1, index),
            self.state.index_select(0, index),
            self.returns.index_select(0, index),
        )


class MappoLearner:
    """Trains the actors of one task.

    Args:
        task: with `config.n_envs` environments; reset here with `config.seed`.
        config: settings.

    Raises:
        InvalidConfig: if the task has another number of environments, discrete actions, or no such device is there.
    """

    def __init__(self, task: Task, config: MappoConfig) -> None:
        if task.n_envs != config.n_envs:
            raise InvalidConfig(f"The task has {task.n_envs} environments, the configuration {config.n_envs}.")
        if task.spec.discrete_actions:
            raise InvalidConfig(f"{task.spec.name} has discrete actions; these actors are Gaussian.")
        self.task, self.config = task, config
        self.device = _device(config.device)
        #: Environment steps collected so far.
        self.steps = 0
        self._generator = torch.Generator().manual_seed(config.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.actor = Actor(task.spec, config).to(self.device)
            self.critic = Critic(task.spec, config).to(self.device)
        self._parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self._optimiser = torch.optim.Adam(self._parameters, lr=config.learning_rate, eps=ADAM_EPSILON, fused=True)
        self._collector = Collector(task, config.seed)
        #: Mean and standard deviation of the last update's rewards; what a new reward is compared with.
        self._reward_moments: tuple[float, float] | None = None
        self._reward_is_new = False

    def collect(self) -> Rollout:
        """Step the task `rollout_steps` times with the actor as it is."""
        with _torch_threads(self.config.n_threads):
            rollout = self._collector.collect(self.actor, self.config.rollout_steps, self._generator)
        self.steps += self.config.steps_per_rollout
        return rollout

    def reward_changed(self) -> None:
        """Say that the next update's rewards come from another function than the last one's.

        A learned reward is defined up to scale and offset, and both move between versions. The critic's units are then
        moved by the affine map that takes the old rewards' mean and spread to the new ones'. If the new version is but
        a rescaling, its values are right at once; if it is more, they start on the right scale. Without the call
        nothing breaks: the statistics follow within some 1 / value_statistics_rate rollouts, with noisy advantages
        meanwhile.
        """
        self._reward_is_new = True

    def update(self, rollout: Rollout, rewards: NDArray[np.floating]) -> dict[str, float]:
        """Improve actors and critic on a rollout.

        Args:
            rollout: the newest one of `collect`.
            rewards: (L, E), shared by the team, or (L, E, N), each agent's own.

        Returns:
            Metrics by name.

        Raises:
            InvalidRewards: if the shape is another or a number is not finite.
            TrainingDiverged: if a gradient is not finite.
        """
        rewards = self._checked(rollout, rewards)
        with _torch_threads(self.config.n_threads):
            return self._update(rollout, rewards)

    def _update(self, rollout: Rollout, rewards: NDArray[np.float32]) -> dict[str, float]:
        metrics = self._follow_reward(rewards)
        batch = self._prepare(rollout, rewards, metrics)
        self._set_learning_rate()
        losses = [self._gradient_step(batch.pick(index)) for index in self._minibatches()]
        metrics |= _averages(losses[-self.config.minibatches :])
        self._absorb_inputs(rollout)
        return metrics | {
            "learning_rate": self._optimiser.param_groups[0]["lr"],
            "action_std": float(self.actor.log_std.detach().exp().mean()),
        }

    def _prepare(self, rollout: Rollout, rewards: NDArray[np.float32], metrics: dict[str, float]) -> _Batch:
        """Advantages and returns by GAE, inputs normalised, agents first for the actor."""
        values, next_values = self._values(rollout.state), self._values(rollout.final_state)
        gains = advantages(
            rewards,
            values,
            next_values,
            rollout.terminated,
            rollout.truncated,
            gamma=self.config.gamma,
            gae_lambda=self.config.gae_lambda,
        )
        returns = gains + values
        metrics["explained_variance"] = float(1.0 - gains.var() / max(returns.var(), 1e-12))
        metrics["return_mean"], metrics["return_std"] = float(returns.mean()), float(returns.std())
        # Over all agents at once: an agent whose actions matter little keeps its small advantages.
        gains = (gains - gains.mean()) / (gains.std() + 1e-8)

        flat_returns = self._flat(returns)
        self.critic.absorb_returns(flat_returns)
        with torch.no_grad():
            return _Batch(
                observations=self.actor.normaliser(self._agent_first(rollout.observations)),
                actions=self._agent_first(rollout.drawn_actions),
                log_probs=self._agent_first(rollout.log_probs),
                advantages=self._agent_first(gains),
                state=self.critic.normaliser(self._flat(rollout.state)),
                returns=self.critic.statistics.normalise(flat_returns),
            )

    def _minibatches(self) -> Iterator[Tensor]:
        size = self.config.steps_per_rollout // self.config.minibatches
        for _ in range(self.config.epochs):
            order = torch.randperm(self.config.steps_per_rollout, generator=self._generator)
            yield from order.to(self.device).split(size)

    def _gradient_step(self, batch: _Batch) -> dict[str, Tensor]:
        log_ratio = self.actor.log_probs(batch.observations, batch.actions) - batch.log_probs
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1.0 - self.config.clip, 1.0 + self.config.clip)
        actor_loss = -torch.minimum(ratio * batch.advantages, clipped * batch.advantages).mean()
        critic_loss = F.mse_loss(self.critic.network(batch.state), batch.returns)
        entropy = self.actor.entropy()
        loss = actor_loss + self.config.value_weight * critic_loss - self.config.entropy_weight * entropy

        self._optimiser.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self._parameters, self.config.max_gradient_norm)
        if not torch.isfinite(norm):
            raise TrainingDiverged(f"The gradient's norm became {norm.item()} after {self.steps} steps.")
        self._optimiser.step()
        with torch.no_grad():
            return {
                "actor_loss": actor_loss.detach(),
                "critic_loss": critic_loss.detach(),
                "entropy": entropy.detach(),
                "gradient_norm": norm,
                # Schulman's low-variance estimate of KL(old, new).
                "kl": (ratio - 1.0 - log_ratio).mean(),
                "clip_fraction": (ratio != clipped).float().mean(),
            }

    def _checked(self, rollout: Rollout, rewards: NDArray[np.floating]) -> NDArray[np.float32]:
        shared = rollout.rewards.shape
        individual = (*shared, self.task.spec.n_agents)
        if rewards.shape not in {shared, individual}:
            raise InvalidRewards(f"Rewards must have the shape {shared} or {individual}, got {rewards.shape}.")
        if not np.isfinite(rewards).all():
            raise InvalidRewards("Rewards must be finite numbers.")
        if rewards.shape == shared:
            rewards = np.broadcast_to(rewards[..., None], individual)
        return rewards.astype(np.float32)

    def _follow_reward(self, rewards: NDArray[np.float32]) -> dict[str, float]:
        """Move the critic's units if the reward is a new one, and remember this one's moments."""
        mean, std = float(rewards.mean()), float(rewards.std())
        if self._reward_is_new and self._reward_moments is not None:
            old_mean, old_std = self._reward_moments
            factor = std / old_std if old_std > 0 and std > 0 else 1.0
            offset = (mean - factor * old_mean) * _discounted_steps(self.config.gamma, self.task.spec.horizon_steps)
            self.critic.statistics.transform(factor, offset)
        self._reward_is_new = False
        self._reward_moments = mean, std
        return {"reward_mean": mean, "reward_std": std}

    @torch.inference_mode()
    def _values(self, state: NDArray[np.float32]) -> NDArray[np.float32]:
        """The critic's values (L, E, N), in units of the reward."""
        return self.critic.values(self._flat(state)).unflatten(0, state.shape[:2]).cpu().numpy()

    def _flat(self, array: NDArray[np.float32]) -> Tensor:
        """(L, E, ...) -> (B, ...)."""
        return torch.from_numpy(array).flatten(0, 1).to(self.device)

    def _agent_first(self, array: NDArray[np.float32]) -> Tensor:
        """(L, E, N, ...) -> (N, B, ...)."""
        return self._flat(array).transpose(0, 1).contiguous()

    def _absorb_inputs(self, rollout: Rollout) -> None:
        """Renew the statistics of inputs last, so that collecting and learning saw the same ones."""
        self.actor.normaliser.absorb(self._agent_first(rollout.observations))
        self.critic.normaliser.absorb(self._flat(rollout.state))

    def _set_learning_rate(self) -> None:
        anneal = self.config.anneal_steps
        done = min(self.steps / anneal, 1.0) if anneal else 0.0
        rate = self.config.learning_rate * (1.0 - (1.0 - FINAL_LEARNING_RATE) * done)
        self._optimiser.param_groups[0]["lr"] = rate

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides the future, flat, as copies on the CPU."""
        parts = {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "optimiser": checkpoint.optimiser_tensors(self._optimiser),
            "collector": self._collector.state_dict(),
            "learner": {
                "steps": torch.tensor(self.steps),
                "generator": self._generator.get_state(),
                "reward_moments": torch.tensor(self._reward_moments or (), dtype=torch.float64),
                "reward_is_new": torch.tensor(self._reward_is_new),
            },
        }
        return checkpoint.flatten(parts)

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Continue exactly, bit for bit on a CPU, as the learner that gave `state_dict` would have.

        Raises:
            InvalidCheckpoint: if it belongs to another task or configuration.
        """
        with checkpoint.refusing_mismatch():
            parts = checkpoint.unflatten(tensors)
            self.actor.load_state_dict(parts["actor"])
            self.critic.load_state_dict(parts["critic"])
            checkpoint.load_optimiser(self._optimiser, parts.get("optimiser", {}))
            self._collector.load_state_dict(parts["collector"])
            own = parts["learner"]
            self._generator.set_state(own["generator"])
            self.steps = int(own["steps"])
            moments = own["reward_moments"].tolist()
            self._reward_moments = (moments[0], moments[1]) if moments else None
            self._reward_is_new = bool(own["reward_is_new"])

    def to_bytes(self) -> bytes:
        """A checkpoint: `state_dict` and the configuration as one safetensors file."""
        return checkpoint.pack(self.state_dict(), {"task": self.task.spec.name, "config": self.config.to_dict()})

    @classmethod
    def from_bytes(cls, content: bytes, task: Task) -> Self:
        """The learner that `to_bytes` wrote.

        Raises:
            InvalidCheckpoint: if it is damaged, or belongs to another task.
        """
        tensors, config = checkpoint.unpack(content, task.spec.name)
        learner = cls(task, MappoConfig.from_dict(config))
        learner.load_state_dict(tensors)
        return learner

    def save(self, path: Path) -> None:
        """Write `to_bytes` to a file; a crash leaves the old file or the new one, whole."""
        checkpoint.write_whole(path, self.to_bytes())

    @classmethod
    def load(cls, path: Path, task: Task) -> Self:
        """The learner that `save` wrote; raises as `from_bytes` does."""
        return cls.from_bytes(path.read_bytes(), task)


@contextmanager
def _torch_threads(n_threads: int) -> Iterator[None]:
    """Let torch use `n_threads`, then as many as before: the process may hold a model that wants more."""
    before = torch.get_num_threads()
    torch.set_num_threads(n_threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _averages(losses: list[dict[str, Tensor]]) -> dict[str, float]:
    return {name: float(torch.stack([loss[name] for loss in losses]).mean()) for name in losses[0]}


def _discounted_steps(gamma: float, horizon_steps: int) -> float:
    """What an offset of 1 in every reward adds to a value: an endless sum, since truncation is bootstrapped."""
    return float(horizon_steps) if gamma == 1.0 else 1.0 / (1.0 - gamma)


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise InvalidConfig("device is cuda, but torch finds no GPU; use auto or cpu.")
    return torch.device(name)
