"""The Multi-Agent Transformer (MAT, Wen et al. 2022): agents choose in turn, each given the actions before its own.

The encoder maps the observations of all agents to representations, which the critic and the decoder read. The decoder
maps them and the actions of the preceding agents to each agent's action distribution: in one masked pass over recorded
actions when training (`Decoder.forward`), agent by agent when acting (`Decoder.sample`).

Inside the transformer, tensors are sample first, (B, N, d). Layers are pre-norm with small residual branches at the
start, which trains without a warm-up of the learning rate.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mapt.policies.config import PolicyConfig
from mapt.policies.distributions import ActionDistribution, Categorical, Gaussian, mean_std, used_dimensions
from mapt.policies.networks import Critic, Policy, initialise
from mapt.policies.normalisation import InputNormaliser, PopArt
from mapt.tasks import TaskSpec

#: Gain of the last layer of each residual branch.
BRANCH_GAIN = 0.1


class KVCache:
    """Keys and values (B, heads, n, d / heads) that one attention has computed for the n agents decoded so far.

    Without it, each agent decoded repeats the work for all before it: a MAT run of 6 agents takes 9% longer, and the
    cost grows with the square of the number of agents.
    """

    def __init__(self) -> None:
        self._keys: Tensor | None = None
        self._values: Tensor | None = None

    def append(self, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Add those of the next agent; return all."""
        self._keys = keys if self._keys is None else torch.cat([self._keys, keys], 2)
        self._values = values if self._values is None else torch.cat([self._values, values], 2)
        return self._keys, self._values


class Attention(nn.Module):
    """Multi-head scaled dot-product attention between agents."""

    def __init__(self, width: int, n_heads: int) -> None:
        super().__init__()
        self.n_heads = n_heads
        self.query, self.key, self.value, self.out = (_linear(width, width, gain=1.0) for _ in range(4))
        initialise(self.out, BRANCH_GAIN)

    def forward(
        self, queries: Tensor, context: Tensor, *, causal: bool = False, cache: KVCache | None = None
    ) -> Tensor:
        """Attend from the agents of `queries` to those of `context`, both (B, N, d).

        Args:
            causal: agent n attends to the agents up to n only.
            cache: keys and values of earlier agents to attend to as well; those of `context` are added.
        """
        query, key, value = (
            self._split(self.query(queries)),
            *map(self._split, (self.key(context), self.value(context))),
        )
        if cache is not None:
            key, value = cache.append(key, value)
        heads = F.scaled_dot_product_attention(query, key, value, is_causal=causal)
        return self.out(heads.transpose(1, 2).flatten(2))

    def _split(self, inputs: Tensor) -> Tensor:
        """(B, N, d) -> (B, heads, N, d / heads)."""
        return inputs.unflatten(-1, (self.n_heads, -1)).transpose(1, 2)


class EncoderLayer(nn.Module):
    """Self-attention of every agent to every agent, then a feed-forward network."""

    def __init__(self, width: int, n_heads: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.attention = Attention(width, n_heads)
        self.feed_forward = _feed_forward(width)

    def forward(self, agents: Tensor) -> Tensor:
        normed = self.norm(agents)
        agents = agents + self.attention(normed, normed)
        return agents + self.feed_forward(agents)


class Encoder(nn.Module):
    """Normalised observations (B, N, C) -> representations (B, N, d).

    It is equivariant to permutations of the agents: only their observations tell them apart.
    """

    def __init__(self, observation_dim: int, config: PolicyConfig) -> None:
        super().__init__()
        self.embed = nn.Sequential(_linear(observation_dim, config.width), nn.GELU())
        self.layers = nn.ModuleList(EncoderLayer(config.width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(config.width)

    def forward(self, observations: Tensor) -> Tensor:
        agents = self.embed(observations)
        for layer in self.layers:
            agents = layer(agents)
        return self.norm(agents)


class DecoderLayer(nn.Module):
    """Causal self-attention over actions, then cross-attention with the encoder's outputs as queries."""

    def __init__(self, width: int, n_heads: int) -> None:
        super().__init__()
        self.norm, self.query_norm, self.context_norm = (nn.LayerNorm(width) for _ in range(3))
        self.self_attention = Attention(width, n_heads)
        self.cross_attention = Attention(width, n_heads)
        self.feed_forward = _feed_forward(width)

    def forward(self, actions: Tensor, encoded: Tensor, caches: tuple[KVCache, KVCache] | None = None) -> Tensor:
        """Representations (B, N, d), from embedded previous actions and the encoder's outputs, both (B, N, d).

        With caches, N is 1: the next agent, which attends to those in the caches.
        """
        causal = caches is None
        self_cache, cross_cache = caches or (None, None)
        normed = self.norm(actions)
        actions = self.context_norm(actions + self.self_attention(normed, normed, causal=causal, cache=self_cache))
        queries = self.query_norm(encoded)
        agents = encoded + self.cross_attention(queries, actions, causal=causal, cache=cross_cache)
        return agents + self.feed_forward(agents)


class Decoder(nn.Module):
    """Representations (B, N, d) and the actions of preceding agents -> distribution of each agent's action."""

    used: Tensor | None

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__()
        self.action_dim = spec.action_dim
        # One input more than an action has: a flag for the first agent, which no action precedes.
        self.embed = nn.Sequential(_linear(spec.action_dim + 1, config.width), nn.GELU())
        self.layers = nn.ModuleList(DecoderLayer(config.width, config.heads) for _ in range(config.layers))
        self.head = _output_head(config.width, spec.action_dim, gain=0.01)
        log_std = torch.full((spec.n_agents, 1, spec.action_dim), config.initial_log_std)
        self.register_buffer("used", used_dimensions(spec), persistent=False)
        self.log_std = None if spec.discrete_actions else nn.Parameter(log_std)

    def forward(self, encoded: Tensor, actions: Tensor, available: Tensor | None) -> ActionDistribution:
        """Distribution of the actions (N, B, A) of all agents, in one pass with a causal mask."""
        agents = self.embed(self._previous_actions(actions.transpose(0, 1)))
        for layer in self.layers:
            agents = layer(agents, encoded)
        return self._distribution(self.head(agents).transpose(0, 1), available)

    def sample(self, encoded: Tensor, noise: Tensor | None, available: Tensor | None) -> tuple[Tensor, Tensor]:
        """Sample actions (N, B, A) agent by agent; return them and their log-probabilities (N, B)."""
        n_samples, n_agents, _ = encoded.shape
        previous = self._previous_actions(encoded.new_zeros(n_samples, n_agents, self.action_dim))
        caches = [(KVCache(), KVCache()) for _ in self.layers]
        outputs: list[Tensor] = []
        for n in range(n_agents):
            own = slice(n, n + 1)
            agent = self.embed(previous[:, own])
            for layer, layer_caches in zip(self.layers, caches, strict=True):
                agent = layer(agent, encoded[:, own], layer_caches)
            outputs.append(self.head(agent).transpose(0, 1))
            if n + 1 < n_agents:
                distribution = self._distribution(outputs[n], None if available is None else available[own], own)
                previous[:, n + 1, 1:] = distribution.sample(None if noise is None else noise[own])[0]
        distribution = self._distribution(torch.cat(outputs), available)
        actions = distribution.sample(noise)
        return actions, distribution.log_prob(actions)

    def _distribution(
        self, outputs: Tensor, available: Tensor | None, agents: slice = slice(None)
    ) -> ActionDistribution:
        """Distribution of the actions of some agents for the network's outputs (n, B, A)."""
        used = None if self.used is None else self.used[agents]
        if self.log_std is None:
            return Categorical(outputs, available, used)
        return Gaussian(outputs, self.log_std[agents], used)

    def _previous_actions(self, actions: Tensor) -> Tensor:
        """Inputs (B, N, 1 + A) of the agents: the action (B, N, A) of the one before, or the flag of the first."""
        previous = F.pad(actions[:, :-1], (1, 0, 1, 0))
        previous[:, 0, 0] = 1.0
        return previous


class EncoderCritic(Critic):
    """Values from the encoder's representations; one output head serves all agents, which share its statistics."""

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__()
        self.encoder = Encoder(spec.observation_dim, config)
        self.head = _output_head(config.width, 1, gain=0.0)
        self.statistics = PopArt(1, config.value_statistics_rate)

    def forward(self, observations: Tensor, state: Tensor) -> Tensor:
        return self.head(self.encoder(observations.transpose(0, 1))).squeeze(-1)

    def last_layer(self) -> nn.Linear:
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        return last


class MultiAgentTransformer(Policy):
    """Encoder, decoder and a critic that shares the encoder."""

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__(spec)
        self.normaliser = InputNormaliser(spec.n_agents, 1, spec.observation_dim, samples_dim=1)
        # Narrower than the declared type, and set once.
        self.critic: EncoderCritic = EncoderCritic(spec, config)  # pyright: ignore[reportIncompatibleVariableOverride]
        self.decoder = Decoder(spec, config)

    def sample(self, observations: Tensor, noise: Tensor | None, available: Tensor | None) -> tuple[Tensor, Tensor]:
        encoded = self.critic.encoder(self.normaliser(observations).transpose(0, 1))
        return self.decoder.sample(encoded, noise, available)

    def evaluate_actions(
        self, observations: Tensor, state: Tensor, actions: Tensor, available: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        encoded = self.critic.encoder(observations.transpose(0, 1))
        distribution = self.decoder(encoded, actions, available)
        return distribution.log_prob(actions), distribution.entropy(), self.critic.head(encoded).squeeze(-1)

    def normalise(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return self.normaliser(observations), state

    def update_normalisers(self, observations: Tensor, state: Tensor) -> None:
        self.normaliser.update(observations)

    def action_std(self) -> float | None:
        log_std = self.decoder.log_std
        return None if log_std is None else mean_std(log_std, self.decoder.used)

    @torch.no_grad()
    def limit_std(self, min_log_std: float) -> None:
        if self.decoder.log_std is not None:
            self.decoder.log_std.clamp_(min=min_log_std)


def _feed_forward(width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.LayerNorm(width), _linear(width, 2 * width), nn.GELU(), _linear(2 * width, width, BRANCH_GAIN)
    )


def _output_head(width: int, n_out: int, gain: float) -> nn.Sequential:
    """(..., d) -> (..., n_out) through one hidden layer; the last layer has orthogonal weights of `gain`."""
    return nn.Sequential(_linear(width, width), nn.GELU(), nn.LayerNorm(width), _linear(width, n_out, gain))


def _linear(n_in: int, n_out: int, gain: float = 2**0.5) -> nn.Linear:
    linear = nn.Linear(n_in, n_out)
    initialise(linear, gain)
    return linear
