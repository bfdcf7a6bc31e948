import pytest
import torch

from mapt.errors import InvalidConfig
from mapt.rewards.kernels import resolve_precision, supports_bfloat16
from mapt.rewards.layers import autocast

pytestmark = pytest.mark.numerics

CPU = torch.device("cpu")


def draw_segments(seed=0):
    generator = torch.Generator().manual_seed(seed)
    observations = torch.randn(6, 12, 3, 4, generator=generator)
    actions = torch.randn(6, 12, 3, 2, generator=generator)
    return observations, actions, torch.ones(6, 12, dtype=torch.bool)


def test_scores_agree_in_both_precisions(build, variant):
    model, segments = build(**variant), draw_segments()
    exact = model(*segments).score
    with autocast(torch.bfloat16, CPU):
        rough = model(*segments).score.float()
    assert not torch.equal(exact, rough)
    # Scores are sums of many products of numbers with 8 bits: a few per cent of their spread, at random weights.
    assert (exact - rough).abs().max() < 0.05 * exact.std() + 0.02 * exact.abs().max()


def test_gradients_agree_in_both_precisions(build):
    model, segments = build(), draw_segments()

    def gradient(dtype):
        model.zero_grad()
        with autocast(dtype, CPU):
            score = model(*segments).score
        score.float().sum().backward()
        assert all(parameter.dtype == torch.float32 for parameter in model.parameters())
        learned = (parameter.grad for parameter in model.parameters())
        return torch.cat([gradient.flatten() for gradient in learned if gradient is not None])

    exact, rough = gradient(torch.float32), gradient(torch.bfloat16)
    assert torch.nn.functional.cosine_similarity(exact, rough, dim=0) > 0.999


def test_float32_changes_nothing(build):
    model, segments = build(), draw_segments()
    with autocast(torch.float32, CPU):
        same = model(*segments).score
    torch.testing.assert_close(same, model(*segments).score, rtol=0, atol=0)


def test_auto_is_bfloat16_for_wide_networks_if_supported():
    wide = torch.bfloat16 if supports_bfloat16(CPU) else torch.float32
    assert resolve_precision("auto", 256, CPU) == wide
    assert resolve_precision("auto", 64, CPU) == torch.float32


def test_named_precision_is_used_and_an_unknown_one_refused():
    assert resolve_precision("bfloat16", 64, CPU) == torch.bfloat16
    assert resolve_precision("float32", 256, CPU) == torch.float32
    with pytest.raises(InvalidConfig) as error:
        resolve_precision("float16", 256, CPU)
    assert error.value.field == "precision"
