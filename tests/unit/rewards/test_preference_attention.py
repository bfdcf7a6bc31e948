import math

import pytest
import torch
from torch import nn

from mapt.rewards.layers import equal_weights, mean_attention
from mapt.rewards.mapt import CooperationAwareAttention, TemporalAwareAttention
from support.tolerance import assert_float32_close

pytestmark = pytest.mark.numerics

S, T, N, D = 4, 7, 3, 16


@pytest.fixture(autouse=True)
def fix_the_torch_seed():
    torch.manual_seed(0)


def randomise(layer: nn.Module, seed: int = 0) -> nn.Module:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.5)
    return layer


def gradients(layer: nn.Module, output: torch.Tensor, x: torch.Tensor) -> dict[str, torch.Tensor]:
    parameters = dict(layer.named_parameters())
    computed = torch.autograd.grad(output.square().sum(), [x, *parameters.values()], allow_unused=True)
    zeros = [torch.zeros_like(value) for value in (x, *parameters.values())]
    return {
        name: zero if gradient is None else gradient
        for name, gradient, zero in zip(("x", *parameters), computed, zeros, strict=True)
    }


def assert_gradients_close(actual: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    # One scale for all gradients, because that of a key's bias, which does not affect the softmax, is a rounding error.
    scale = max(gradient.abs().max().item() for gradient in expected.values())
    for name, gradient in actual.items():
        torch.testing.assert_close(gradient, expected[name], rtol=0, atol=1e-4 * scale, msg=name)


def test_agent_rewards_follow_their_equation():
    layer, h = randomise(CooperationAwareAttention(2 * D, D)), torch.randn(S, T, N, 2 * D, requires_grad=True)
    weights = (layer.query(h) @ layer.key(h).transpose(2, 3) / math.sqrt(D)).softmax(dim=-1)
    plain = layer.reward(weights @ layer.value(h)).squeeze(-1)
    assert_float32_close(layer(h).detach(), plain.detach())
    expected = gradients(layer, plain, h)
    assert_gradients_close(gradients(layer, layer(h), h), expected)


@pytest.mark.parametrize("key_dim", [N, 2 * D], ids=["keys-of-rewards", "keys-of-features"])
def test_step_attention_follows_its_equation(key_dim):
    layer = randomise(TemporalAwareAttention(2 * D, D, key_dim))
    queries, keys = torch.randn(S, T, 2 * D, requires_grad=True), torch.randn(S, T, key_dim)
    mask = torch.arange(T) < torch.tensor([7, 1, 4, 6])[:, None]
    logits = layer.query(queries) @ layer.key(keys).transpose(1, 2) / math.sqrt(D)
    plain = logits.masked_fill(~mask[:, None], float("-inf")).softmax(dim=-1)
    weights = layer(queries, keys, mask)
    assert_float32_close(weights.detach(), plain.detach())
    expected = gradients(layer, plain, queries)
    assert_gradients_close(gradients(layer, weights, queries), expected)


def test_padded_steps_have_no_weight():
    mask = torch.tensor([[True, True, False]])
    weights = torch.tensor([[[0.75, 0.25, 0.0], [0.25, 0.75, 0.0], [1.0, 0.0, 0.0]]])
    torch.testing.assert_close(mean_attention(weights, mask), torch.tensor([[0.5, 0.5, 0.0]]))
    torch.testing.assert_close(equal_weights(mask), torch.tensor([[0.5, 0.5, 0.0]]))


def test_untrained_step_attention_gives_equal_weights():
    layer = TemporalAwareAttention(2 * D, D, N)
    mask = torch.arange(T) < torch.tensor([7, 3])[:, None]
    weights = layer(torch.randn(2, T, 2 * D), torch.randn(2, T, N), mask)
    torch.testing.assert_close(mean_attention(weights, mask), equal_weights(mask))
