import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mapt.rewards.kernels import BandedAttention
from mapt.rewards.layers import CausalAttention, rotary_embedding, rotate
from support.tolerance import assert_float32_close

pytestmark = pytest.mark.numerics


def assert_close(actual: torch.Tensor, expected: torch.Tensor) -> None:
    assert_float32_close(actual.detach(), expected.detach())


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def slow_attention(query, key, value, band):
    """Attention computed in loops over steps and groups, each over the steps of its window and episode."""
    result = torch.zeros_like(query)
    n_segments, n_queries, n_groups, dim = query.shape
    for s in range(n_segments):
        for query_step in range(n_queries):
            t = query_step + band.context_steps
            seen = [k for k in range(max(0, t - band.window + 1), t + 1) if band.episode[s, k] == band.episode[s, t]]
            for g in range(n_groups):
                logits = key[s, seen, g] @ query[s, query_step, g] / dim**0.5
                result[s, query_step, g] = logits.softmax(0) @ value[s, seen, g]
    return result


@settings(max_examples=25)
@given(st.integers(1, 45), st.integers(0, 30), st.integers(1, 20), st.floats(0, 0.4), st.integers(0, 99))
def test_banded_attention_equals_the_slow_loop(n_queries, context, window, start_rate, seed):
    generator, n_steps = torch.Generator().manual_seed(seed), context + n_queries
    starts = torch.rand(2, n_steps, generator=generator) < start_rate
    band = BandedAttention(window, starts.cumsum(dim=1), context)
    query = draw(2, n_queries, 2, 4, seed=seed)
    key, value = (draw(2, n_steps, 2, 4, seed=seed + i) for i in (1, 2))
    fast = band.attend(query, key, value)
    assert_close(fast, slow_attention(query, key, value, band))


@given(st.integers(0, 2000), st.integers(0, 60), st.integers(0, 99))
def test_rotary_products_depend_on_the_distance_only(position, distance, seed):
    angles = rotary_embedding(torch.arange(2100, dtype=torch.float64), 8, torch.device("cpu"))
    query, key = draw(8, seed=seed), draw(8, seed=seed + 1)

    def product(at):
        at_query, at_key = (
            (table[at : at + 1] for table in angles),
            (table[at + distance : at + distance + 1] for table in angles),
        )
        return (rotate(query.view(1, 1, 1, 8), *at_query) * rotate(key.view(1, 1, 1, 8), *at_key)).sum()

    scale = (query.norm() * key.norm()).item()
    torch.testing.assert_close(product(position), product(0), rtol=0, atol=1e-4 * scale)


def test_attention_is_invariant_to_a_shift_in_time():
    attention = CausalAttention(8, 8, heads=2)
    torch.nn.init.normal_(attention.out.weight, generator=torch.Generator().manual_seed(0))
    x = draw(1, 40, 3, 8)
    whole = attention(x, BandedAttention(10, torch.zeros(1, 40, dtype=torch.int64)))
    for last in (9, 10, 23, 39):
        window = attention(x[:, last - 9 : last + 1])
        assert_close(whole[:, last], window[:, -1])


def test_context_serves_as_keys_only():
    attention = CausalAttention(8, 8, heads=2)
    torch.nn.init.normal_(attention.out.weight, generator=torch.Generator().manual_seed(0))
    x, episode = draw(2, 30, 3, 8), torch.zeros(2, 30, dtype=torch.int64)
    whole, with_context = (attention(x, BandedAttention(10, episode, context)) for context in (0, 9))
    assert_close(with_context, whole[:, 9:])
