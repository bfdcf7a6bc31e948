"""The transformer's decoder, agent after agent: keys and values of those who chose already are kept.

What it computes is what `TeamDecoder` does over all agents at once. A moment of few environments is decoded in many
tiny products, whose number is what counts: weights that read the same are joined, and what does not wait for actions is
computed for all agents beforehand.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mapt.policies.transformer import DecoderLayer, TeamDecoder


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
