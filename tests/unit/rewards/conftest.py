from collections.abc import Callable

import numpy as np
import pytest
import torch

from mapt.preferences.dataset import SegmentArrays
from mapt.rewards.config import RewardConfig
from mapt.rewards.mapt import MAPT

N_AGENTS, OBSERVATION_DIM, ACTION_DIM = 3, 4, 2
LENGTHS = (7, 4)
VARIANTS: dict[str, dict[str, object]] = {
    "mapt": {},
    "mapt-tpa": {"tpa": False},
    "mapt-cpa": {"cpa": False},
    "mapt*": {"temporal": "lstm"},
    "two-layers": {"layers": 2},
    "no-past": {"temporal": "none"},
    "attention-path-alone": {"markov_path": False},
    "no-attention": {"temporal": "none", "agent_attention": False, "cpa": False, "tpa": False},
}


@pytest.fixture(params=VARIANTS.values(), ids=VARIANTS.keys())
def variant(request) -> dict[str, object]:
    """Settings of one of the network's variants."""
    return request.param


@pytest.fixture
def build() -> Callable[..., MAPT]:
    """Builds a small network in evaluation mode without zero-initialised layers."""

    def build(seed: int = 0, **settings: object) -> MAPT:
        config = RewardConfig.from_dict(
            {
                "observation_dim": OBSERVATION_DIM,
                "action_dim": ACTION_DIM,
                "n_agents": N_AGENTS,
                "hidden_dim": 16,
                **settings,
            }
        )
        model = MAPT(config).eval()
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.3)
        return model

    return build


@pytest.fixture
def segments() -> SegmentArrays:
    """Segments of `LENGTHS` steps, padded to the longest."""
    rng = np.random.default_rng(0)
    return SegmentArrays.stack(
        [rng.standard_normal((length, N_AGENTS, OBSERVATION_DIM)) for length in LENGTHS],
        [rng.standard_normal((length, N_AGENTS, ACTION_DIM)) for length in LENGTHS],
    )
