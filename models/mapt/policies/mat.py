"""The Multi-Agent Transformer (Wen et al. 2022): agents decide one after the other, each knowing the choices before."""

import torch
from torch import Tensor, nn

from mapt.policies.actions import ActionDistribution, Categorical, Gaussian, mean_std, used_numbers
from mapt.policies.config import PolicyConfig
from mapt.policies.critics import EncoderCritic
from mapt.policies.decoding import decode
from mapt.policies.normalisation import InputNormaliser
from mapt.policies.policy import Batch, Evaluation, Policy
from mapt.policies.transformer import TeamDecoder
from mapt.tasks import TaskSpec


class Decoder(nn.Module):
    """The transformer's decoder and the spread of each agent's actions around what it says."""

    used: Tensor | None

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__()
        self.network = TeamDecoder(spec.action_dim, config)
        spread = torch.full((spec.n_agents, 1, spec.action_dim), config.initial_log_std)
        self.register_buffer("used", used_numbers(spec), persistent=False)
        self.log_std = None if spec.discrete_actions else nn.Parameter(spread)

    def distribution(self, seen: Tensor, actions: Tensor, available: Tensor | None) -> ActionDistribution:
        """Of actions (N, B, A), agent first, given those before each; `seen` (B, N, d)."""
        return self._of_outputs(self.network(seen, actions.transpose(0, 1)).transpose(0, 1), available)

    def draw(self, seen: Tensor, noise: Tensor | None, available: Tensor | None) -> tuple[Tensor, Tensor]:
        """Actions (N, B, A) and log-probabilities (N, B), agent after agent."""

        def choose(agent: int, output: Tensor) -> Tensor:
            own = slice(agent, agent + 1)
            of_agent = self._of_outputs(output[None], None if available is None else available[own], own)
            return of_agent.choose(None if noise is None else noise[own])[0]

        return self._of_outputs(decode(self.network, seen, choose), available).draw(noise)

    def _of_outputs(self, outputs: Tensor, available: Tensor | None, agents: slice = slice(None)) -> ActionDistribution:
        """Of actions of some agents (n, B, A), by the network's outputs for them."""
        used = None if self.used is None else self.used[agents]
        if self.log_std is None:
            return Categorical.masked(outputs, available, used)
        return Gaussian(outputs, self.log_std[agents], used)


class MultiAgentTransformer(Policy):
    """Encoder and decoder; the critic reads the encoder's representations, and so does the decoder."""

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__(spec)
        self.normaliser = InputNormaliser(spec.n_agents, 1, spec.observation_dim, over=1)
        # Narrower than the declared type, and set once.
        self.critic: EncoderCritic = EncoderCritic(spec, config)  # pyright: ignore[reportIncompatibleVariableOverride]
        self.decoder = Decoder(spec, config)

    def draw(self, observations: Tensor, noise: Tensor | None, available: Tensor | None) -> tuple[Tensor, Tensor]:
        seen = self.critic.encoder(self.normaliser(observations).transpose(0, 1))
        return self.decoder.draw(seen, noise, available)

    def evaluate(self, batch: Batch) -> Evaluation:
        seen = self.critic.encoder(batch.observations.transpose(0, 1))
        distribution = self.decoder.distribution(seen, batch.actions, batch.available)
        return Evaluation(distribution.log_probs(batch.actions), distribution, self.critic.head(seen).squeeze(-1))

    def normalised(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return self.normaliser(observations), state

    def absorb_inputs(self, observations: Tensor, state: Tensor) -> None:
        self.normaliser.absorb(observations)

    def action_std(self) -> float | None:
        log_std = self.decoder.log_std
        return None if log_std is None else mean_std(log_std, self.decoder.used)
