"""Training and relabelling of MAPT, beside the matrix multiplication ceiling of the same machine in the same run.

The ceiling is what torch reaches on matrices of the network's own shapes: many rows, d to 2d columns. The share is that
of the multiplications alone: norms, activations and the softmax of the attention count as time, not as work.

    python tests/benchmarks/bench_rewards.py [threads]
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.rewards.config import PresetName, RewardConfig
from mapt.rewards.network import MAPT
from mapt.rewards.relabelling import RolloutRelabeller
from mapt.rewards.train_config import TrainConfig
from mapt.rewards.trainer import train_reward_model

N_AGENTS, OBSERVATION_DIM, ACTION_DIM = 6, 24, 1
LEAST_SECONDS = 2.0
N_ENVS, ROLLOUT_STEPS = 40, 100


@dataclass(frozen=True, slots=True)
class Size:
    """One row of the table."""

    preset: PresetName
    n_steps: int
    n_pairs: int


SIZES = (Size("small", 50, 64), Size("small", 100, 64), Size("paper", 50, 16), Size("paper", 100, 16))


def main() -> None:
    torch.set_num_threads(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
    print(f"{torch.get_num_threads()} threads; {N_AGENTS} agents, {OBSERVATION_DIM} observed numbers each")
    print(
        f"{'preset':7} {'T':>4} {'ceiling':>14} {'whole network':>16} {'share':>6}"
        f" {'Markov path':>14} {'relabelling':>20}"
    )
    for size in SIZES:
        ceiling = gemm_flops(2 * RewardConfig.preset(size.preset, **dimensions()).hidden_dim)
        whole, markov = training_rates(size)
        share = whole * 3 * flops_per_step(size.preset) * 2 * size.n_steps * N_AGENTS / ceiling
        print(
            f"{size.preset:7} {size.n_steps:4} {ceiling / 1e9:7.0f} GFLOP/s {whole:9.0f} pairs/s {share:6.0%}"
            f" {markov:7.0f} pairs/s {relabelling_rate(size):9,.0f} transitions/s"
        )


def dimensions() -> dict[str, int]:
    return {"observation_dim": OBSERVATION_DIM, "action_dim": ACTION_DIM, "n_agents": N_AGENTS}


def gemm_flops(width: int) -> float:
    """Floating point operations a second of a product shaped like the network's: rows x width by width x width / 2."""
    left, right = torch.randn(19_200, width), torch.randn(width, width // 2)
    calls = calls_per_second(lambda: left @ right)
    return calls * 2 * left.shape[0] * right.numel()


def flops_per_step(preset: PresetName) -> float:
    """Multiplications and additions of all linear layers for one step of one agent, forwards."""
    model = MAPT(RewardConfig.preset(preset, **dimensions()))
    linear = [layer for layer in model.modules() if isinstance(layer, torch.nn.Linear)]
    return 2.0 * sum(layer.weight.numel() for layer in linear)


def calls_per_second(call: Callable[[], object]) -> float:
    call()
    n_calls, started = 0, time.perf_counter()
    while time.perf_counter() - started < LEAST_SECONDS:
        call()
        n_calls += 1
    return n_calls / (time.perf_counter() - started)


def training_rates(size: Size) -> tuple[float, float]:
    """Pairs a second in training: of the whole network, and of the Markov path alone."""
    config = RewardConfig.preset(size.preset, **dimensions())
    data = random_preferences(size)

    def pairs_per_second(settings: TrainConfig) -> float:
        trained = train_reward_model(data, config, settings)
        # The first epoch warms up; the one of the other stage, if any, comes last.
        ends = [at.seconds for at in trained.history[: settings.markov_epochs or None]]
        n_trained = trained.metrics["labels"] - trained.metrics["holdout_labels"]
        return n_trained * (len(ends) - 1) / (ends[-1] - ends[0])

    settings = TrainConfig(batch_pairs=size.n_pairs, patience=10**6, device="cpu")
    whole = pairs_per_second(replace(settings, markov_epochs=0, max_epochs=4))
    return whole, pairs_per_second(replace(settings, markov_epochs=10, max_epochs=1))


def random_preferences(size: Size) -> PreferenceDataset:
    rng = np.random.default_rng(0)
    # Eight batches and a hold-out of a tenth: fewer would make smaller batches.
    n_pairs = 10 * size.n_pairs
    shape = (2 * n_pairs, size.n_steps, N_AGENTS)
    segments = SegmentArrays(
        rng.standard_normal((*shape, OBSERVATION_DIM), dtype=np.float32),
        rng.standard_normal((*shape, ACTION_DIM), dtype=np.float32),
        np.ones(shape[:2], dtype=np.bool_),
    )
    labels = rng.integers(0, 2, n_pairs).astype(np.float32)
    return PreferenceDataset(segments, np.arange(2 * n_pairs).reshape(-1, 2), labels)


def relabelling_rate(size: Size) -> float:
    """Transitions a second: steps of environments, each with all its agents."""
    model = MAPT(RewardConfig.preset(size.preset, **dimensions()))
    relabeller = RolloutRelabeller(model, size.n_steps, N_ENVS)
    rng = np.random.default_rng(0)
    shape = (ROLLOUT_STEPS, N_ENVS, N_AGENTS)
    observations = rng.standard_normal((*shape, OBSERVATION_DIM), dtype=np.float32)
    actions = rng.standard_normal((*shape, ACTION_DIM), dtype=np.float32)
    start = rng.random((ROLLOUT_STEPS, N_ENVS)) < 0.002
    return calls_per_second(lambda: relabeller.relabel(observations, actions, start)) * ROLLOUT_STEPS * N_ENVS


if __name__ == "__main__":
    main()
