"""CPU time of a policy update with the kernels of `mapt.policies.kernels`, and with the torch functions they replace.

The variants alternate, pass by pass, on one thread. Figures are the extra CPU time without a kernel, relative to the
update and to a whole iteration (rollout and update); lower quartiles over passes, which other load affects least.

    python tests/benchmarks/bench_kernels.py [--task HalfCheetah-6x1] [--algorithms mappo happo mat mat_dec]
        [--rounds 20]
"""

import argparse
import statistics
import time
from collections.abc import Callable, Iterable
from typing import get_args

import torch
from torch import Tensor, nn
from torch.distributions import Normal

from mapt.policies import Algorithm, Learner, PolicyConfig, ppo
from mapt.policies.distributions import Gaussian
from mapt.policies.kernels import clip_grad_norm_
from mapt.tasks import make_task


class TorchAdam:
    """torch's Adam with the interface of the kernel."""

    def __init__(self, parameters: Iterable[nn.Parameter], learning_rate: float, eps: float) -> None:
        self.parameters = list(parameters)
        self.learning_rate = learning_rate
        adam = torch.optim.Adam(self.parameters, learning_rate, eps=eps, fused=True)
        self.zero_grad, self.step = adam.zero_grad, adam.step


def normal_log_prob(distribution: Gaussian, actions: Tensor) -> Tensor:
    """Log-density by torch's normal distribution, for agents that use all action dimensions."""
    normal = Normal(distribution.mean, distribution.log_std.exp(), validate_args=False)
    return normal.log_prob(actions).sum(-1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="HalfCheetah-6x1")
    parser.add_argument("--algorithms", nargs="+", choices=get_args(Algorithm), default=list(get_args(Algorithm)))
    parser.add_argument("--rounds", type=int, default=20)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{'algorithm':<11}{'without':<26}{'update':>9}{'whole':>9}")
    for algorithm in arguments.algorithms:
        compare(arguments.task, algorithm, arguments.rounds)


def compare(task_name: str, algorithm: str, rounds: int) -> None:
    """Print the extra time of each variant."""
    config = PolicyConfig.named(algorithm, epochs=1, device="cpu")
    learner = Learner(make_task(task_name, config.n_envs), config)
    collecting: list[float] = []
    for _ in range(4):
        started = time.process_time()
        rollout = learner.collect()
        collecting.append(time.process_time() - started)
        learner.update(rollout, rollout.rewards)
    rollout = learner.collect()
    batch, _ = ppo.make_batch(learner.policy, rollout, ppo.team_rewards(rollout.rewards, rollout), config, config.gamma)
    updates = {
        "": ppo_update(learner, None),
        "Adam": ppo_update(learner, TorchAdam),
    }

    def one_pass(update: ppo.Update, clip: Callable[..., Tensor], log_prob: Callable[..., Tensor]) -> float:
        before = ppo.clip_grad_norm_, Gaussian.log_prob
        ppo.clip_grad_norm_, Gaussian.log_prob = clip, log_prob
        started = time.process_time()
        update.run(batch, torch.Generator().manual_seed(0))
        seconds = time.process_time() - started
        ppo.clip_grad_norm_, Gaussian.log_prob = before
        return seconds

    torch_clip, plain = nn.utils.clip_grad_norm_, Gaussian.log_prob
    variants = {
        "nothing": (updates[""], clip_grad_norm_, plain),
        "Adam": (updates["Adam"], clip_grad_norm_, plain),
        "clip_grad_norm_": (updates[""], torch_clip, plain),
        "Adam, clip_grad_norm_": (updates["Adam"], torch_clip, plain),
        "log-density": (updates[""], clip_grad_norm_, normal_log_prob),
        "all three": (updates["Adam"], torch_clip, normal_log_prob),
    }
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(rounds + 1):
        for name, variant in variants.items():
            seconds[name].append(one_pass(*variant))
    passes = {name: lower_quartile(each[1:]) for name, each in seconds.items()}
    epochs = PolicyConfig.named(algorithm).epochs
    whole = min(collecting) + epochs * passes["nothing"]
    for name, each in passes.items():
        extra = each - passes["nothing"]
        print(f"{algorithm:<11}{name:<26}{extra / passes['nothing']:>+9.1%}{epochs * extra / whole:>+9.1%}", flush=True)


def lower_quartile(seconds: list[float]) -> float:
    return statistics.quantiles(seconds, n=4)[0]


def ppo_update(learner: Learner, adam: type[TorchAdam] | None) -> ppo.Update:
    """An update of the learner's policy with the given Adam, or with the kernel if it is None."""
    before = ppo.Adam
    if adam is not None:
        ppo.Adam = adam  # pyright: ignore[reportAttributeAccessIssue]
    try:
        config, policy = learner.config, learner.policy
        happo = isinstance(policy, ppo.ActorCritic) and config.algorithm == "happo"
        return ppo.HAPPOUpdate(policy, config) if happo else ppo.PPOUpdate(policy, config)
    finally:
        ppo.Adam = before


if __name__ == "__main__":
    main()
