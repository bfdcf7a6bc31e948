"""Policies whose agents decide each for itself: MAPPO, HAPPO, and MAT with decentralised actors."""

from torch import Tensor

from mapt.policies.actions import mean_std
from mapt.policies.actors import Actors
from mapt.policies.config import PolicyConfig
from mapt.policies.critics import Critic, EncoderCritic, StateCritic
from mapt.policies.policy import Batch, Evaluation, Policy
from mapt.tasks import TaskSpec


class ActorCritic(Policy):
    """Decentralised actors beside a central critic."""

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__(spec)
        self.actor = Actors(spec, config)
        self.critic: Critic = (EncoderCritic if config.algorithm == "mat_dec" else StateCritic)(spec, config)

    def draw(self, observations: Tensor, noise: Tensor | None, available: Tensor | None) -> tuple[Tensor, Tensor]:
        return self.actor(self.actor.normaliser(observations), available).draw(noise)

    def evaluate(self, batch: Batch) -> Evaluation:
        log_probs, distribution = self.actor.evaluate(batch.observations, batch.actions, batch.available)
        return Evaluation(log_probs, distribution, self.critic(batch.observations, batch.state))

    def normalised(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return self.actor.normaliser(observations), self.critic.normalised(state)

    def absorb_inputs(self, observations: Tensor, state: Tensor) -> None:
        self.actor.normaliser.absorb(observations)
        self.critic.absorb_inputs(state)

    def action_std(self) -> float | None:
        log_std = self.actor.log_std
        return None if log_std is None else mean_std(log_std, self.actor.used)
