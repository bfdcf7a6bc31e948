"""The Multi-Agent Transformer's encoder and decoder (Wen et al. 2022), over the N agents of one moment.

Tensors are sample first, (B, N, d). The decoder takes agents in order: what it says of an agent depends on what all
agents see and on the actions of the agents before it, whether it is run over all at once or one after the other, as
`decoding` does.
Layers are pre-norm and start close to passing their input on, which trains without a warm-up.
"""

from torch import Tensor, nn
from torch.nn import functional as F

from mapt.policies.config import PolicyConfig
from mapt.policies.layers import initialise

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
