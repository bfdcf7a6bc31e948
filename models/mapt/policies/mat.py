"""The Multi-Agent Transformer's encoder and decoder (Wen et al. 2022), over the N agents of one moment.

Tensors are sample first, (B, N, d). The decoder takes agents in order: what it says of an agent depends on what all
agents see and on the actions of the agents before it, whether it is run over all at once or one after the other, as
`decoding` does.
Layers are pre-norm and start close to passing their input on, which trains without a warm-up.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mapt.policies.config import PolicyConfig
from mapt.policies.distributions import ActionDistribution, Categorical, Gaussian, mean_std, used_numbers
from mapt.policies.networks import Batch, Critic, Evaluation, Policy, initialise
from mapt.policies.normalisation import InputNormaliser, ReturnStatistics
from mapt.tasks import TaskSpec

#: Gain of the layers that add to what passes by.
BRANCH_GAIN = 0.1


class Attention(nn.Module):
    """Dot-product attention of each agent to all agents, or to those up to itself."""

    def __init__(self, width: int, n_heads: int) -> None:
        super().__init__()
        self.n_heads = n_heads
        self.query, self.key, self.value, self.out = (_linear(width, width, gain=1.0) for _ in range(4))
        initialise(self.out, BRANCH_GAIN)

    def forward(self, asking: Tensor, asked: Tensor, *, causal: bool) -> Tensor:
        """(B, N, d) for each agent of `asking` from all of `asked` (B, N, d), or from those not after it."""
        query, key, value = (
            self._split(self.query(asking)),
            self._split(self.key(asked)),
            self._split(self.value(asked)),
        )
        return self._join(F.scaled_dot_product_attention(query, key, value, is_causal=causal))

    def _split(self, inputs: Tensor) -> Tensor:
        return inputs.unflatten(-1, (self.n_heads, -1)).transpose(1, 2)

    def _join(self, heads: Tensor) -> Tensor:
        return self.out(heads.transpose(1, 2).flatten(2))


class EncoderLayer(nn.Module):
    """Every agent attends to every agent."""

    def __init__(self, width: int, n_heads: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.attention = Attention(width, n_heads)
        self.feed_forward = _feed_forward(width)

    def forward(self, agents: Tensor) -> Tensor:
        normed = self.norm(agents)
        agents = agents + self.attention(normed, normed, causal=False)
        return agents + self.feed_forward(agents)


class DecoderLayer(nn.Module):
    """Each agent attends to the actions before its own, then asks of them by what is seen."""

    def __init__(self, width: int, n_heads: int) -> None:
        super().__init__()
        self.norm, self.seen_norm, self.done_norm = (nn.LayerNorm(width) for _ in range(3))
        self.among_actions = Attention(width, n_heads)
        self.from_seen = Attention(width, n_heads)
        self.feed_forward = _feed_forward(width)

    def forward(self, done: Tensor, seen: Tensor) -> Tensor:
        """(B, N, d) of embedded previous actions and of representations of what is seen."""
        normed = self.norm(done)
        done = self.done_norm(done + self.among_actions(normed, normed, causal=True))
        return self.finish(seen, self.from_seen(self.seen_norm(seen), done, causal=True))

    def finish(self, seen: Tensor, found: Tensor) -> Tensor:
        """Outputs of agents (..., d), of what is seen and what was found by asking."""
        agents = seen + found
        return agents + self.feed_forward(agents)


class TeamEncoder(nn.Module):
    """Normalised observations (B, N, C) -> representations (B, N, d), each of one agent among the others.

    Nothing in it says which agent is which: agents that differ say so in their observations.
    """

    def __init__(self, observation_dim: int, config: PolicyConfig) -> None:
        super().__init__()
        width = config.width
        self.embed = nn.Sequential(_linear(observation_dim, width), nn.GELU())
        self.layers = nn.ModuleList(EncoderLayer(width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, observations: Tensor) -> Tensor:
        agents = self.embed(observations)
        for layer in self.layers:
            agents = layer(agents)
        return self.norm(agents)


class TeamDecoder(nn.Module):
    """Representations (B, N, d) and the actions before each agent's own -> outputs (B, N, A)."""

    def __init__(self, action_dim: int, config: PolicyConfig) -> None:
        super().__init__()
        width = config.width
        self.action_dim = action_dim
        # One more input than an action has: it tells the first agent that nobody acted before it.
        self.embed = nn.Sequential(_linear(action_dim + 1, width), nn.GELU())
        self.layers = nn.ModuleList(DecoderLayer(width, config.heads) for _ in range(config.layers))
        self.head = output_head(width, action_dim, gain=0.01)

    def forward(self, seen: Tensor, actions: Tensor) -> Tensor:
        """One pass over all agents; output n reads actions (B, N, A) before n alone."""
        agents = self.embed(self.tokens(actions))
        for layer in self.layers:
            agents = layer(agents, seen)
        return self.head(agents)

    def tokens(self, actions: Tensor) -> Tensor:
        """What each agent is told (B, N, 1 + A) of the action before its own, for actions (B, N, A)."""
        told = F.pad(actions[:, :-1], (1, 0, 1, 0))
        told[:, 0, 0] = 1.0
        return told


def output_head(width: int, n_out: int, gain: float) -> nn.Sequential:
    """(..., d) -> (..., n_out) by one hidden layer; the last layer starts at `gain`."""
    return nn.Sequential(_linear(width, width), nn.GELU(), nn.LayerNorm(width), _linear(width, n_out, gain))


def _feed_forward(width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.LayerNorm(width), _linear(width, 2 * width), nn.GELU(), _linear(2 * width, width, BRANCH_GAIN)
    )


def _linear(n_in: int, n_out: int, gain: float = 2**0.5) -> nn.Linear:
    linear = nn.Linear(n_in, n_out)
    initialise(linear, gain)
    return linear


def decode(decoder: TeamDecoder, seen: Tensor, choose: Callable[[int, Tensor], Tensor]) -> Tensor:
    """Outputs (N, B, A) for what all agents see (B, N, d).

    Args:
        choose: gives the action (B, A) of an agent, of its number and its output (B, A).
    """
    n_samples, n_agents, _ = seen.shape
    tokens = decoder.tokens(seen.new_zeros(n_samples, n_agents, decoder.action_dim))
    layers = [_Layer(layer, seen) for layer in decoder.layers]
    outputs: list[Tensor] = []
    for agent in range(n_agents):
        agents = decoder.embed(tokens[:, agent])
        for layer in layers:
            agents = layer.step(agents, agent)
        outputs.append(decoder.head(agents))
        if agent + 1 < n_agents:
            tokens[:, agent + 1, 1:] = choose(agent, outputs[-1])
    return torch.stack(outputs)


class _Layer:
    """A layer at work on one moment."""

    def __init__(self, layer: nn.Module, seen: Tensor) -> None:
        assert isinstance(layer, DecoderLayer)
        self._layer, self._seen = layer, seen
        among, asking = layer.among_actions, layer.from_seen
        self._width = seen.shape[-1]
        self._questions = asking.query(layer.seen_norm(seen))
        self._among = _joined(among.query, among.key, among.value)
        self._told = _joined(asking.key, asking.value)
        self._actions, self._done = _Memory(seen, among.n_heads), _Memory(seen, asking.n_heads)

    def step(self, done: Tensor, agent: int) -> Tensor:
        """Output (B, d) of the next agent for its input (B, d)."""
        layer = self._layer
        joined = F.linear(layer.norm(done), *self._among)
        self._actions.write(agent, joined[:, self._width :])
        found = self._actions.ask(agent, joined[:, : self._width])
        done = layer.done_norm(done + layer.among_actions.out(found))
        self._done.write(agent, F.linear(done, *self._told))
        found = self._done.ask(agent, self._questions[:, agent])
        return layer.finish(self._seen[:, agent], layer.from_seen.out(found))


class _Memory:
    """Keys and values of the agents so far, for an attention of some heads over representations (B, N, d)."""

    def __init__(self, like: Tensor, n_heads: int) -> None:
        n_samples, n_agents, width = like.shape
        stored = like.new_empty(n_samples, n_agents, 2, n_heads, width // n_heads)
        self._rows = stored.flatten(2)
        self._keys, self._values = (stored[:, :, half].transpose(1, 2) for half in (0, 1))
        self._head_shape = (n_samples, n_heads, 1, width // n_heads)

    def write(self, agent: int, key_and_value: Tensor) -> None:
        """(B, 2d) of the next agent."""
        self._rows[:, agent] = key_and_value

    def ask(self, agent: int, query: Tensor) -> Tensor:
        """What an agent's query (B, d) finds among the agents up to itself, (B, d)."""
        known = slice(0, agent + 1)
        heads = F.scaled_dot_product_attention(
            query.reshape(self._head_shape), self._keys[:, :, known], self._values[:, :, known]
        )
        return heads.flatten(1)


def _joined(*linears: nn.Linear) -> tuple[Tensor, Tensor]:
    """Weights and bias of one linear layer that gives what these give, side by side."""
    return torch.cat([linear.weight for linear in linears]), torch.cat([linear.bias for linear in linears])


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


class EncoderCritic(Critic):
    """Reads what all agents see, with the transformer's encoder; one head serves all agents, so they share units."""

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__()
        self.encoder = TeamEncoder(spec.observation_dim, config)
        self.head = output_head(config.width, 1, gain=0.0)
        self.statistics = ReturnStatistics(1, config.value_statistics_rate)

    def forward(self, observations: Tensor, state: Tensor) -> Tensor:
        return self.head(self.encoder(observations.transpose(0, 1))).squeeze(-1)

    def last_layer(self) -> nn.Linear:
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        return last


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
