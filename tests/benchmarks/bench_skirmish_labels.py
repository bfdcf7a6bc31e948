"""How often teams win a skirmish map after training on an oracle's labels: the preference loop without a service.

One process, one thread; MAPPO with the settings of the task. Each seed trains a team and plays 256 episodes with
mean actions. MODEL is a reward model, or `true` for the task's own reward, which needs no labels.

    python tests/benchmarks/bench_skirmish_labels.py [MODEL] [LABELS] [STEPS] [SEEDS] [SEGMENT_STEPS] [MAP]
"""

import math
import sys

import torch
from bench_skirmish import EPISODES, make

from mapt.policies import Learner, PolicyConfig
from mapt.policies.episodes import play
from mapt.preferences.teachers import make_teacher
from mapt.tasks import make_task, task_spec
from mapt.training.policy_trainer import PolicyTrainer
from mapt.training.preference_loop import PreferenceLoop, RewardSettings
from mapt.training.schedule import LabelSchedule


def train(task: str, model: str, labels: int, steps: int, seed: int, segment_steps: int) -> tuple[Learner, float]:
    """The trained learner, and the held-out accuracy of the last reward version; NaN without one."""
    config = PolicyConfig.for_task(task_spec(task), {"seed": seed, "device": "cpu"})
    learner = Learner(make_task(task, config.n_envs), config)
    if model == "true":
        PolicyTrainer(learner).train(steps)
        return learner, math.nan
    # The first labels and those of a version, as in `accord demo`.
    schedule = LabelSchedule(labels, min(labels // 5, 100), steps, per_version=labels // 10)
    reward = RewardSettings(segment_steps=segment_steps, model=model, seed=seed, device="cpu")
    loop = PreferenceLoop(learner, make_teacher("oracle", seed=seed), schedule, reward)
    loop.run()
    return learner, loop.versions[-1].metrics["holdout_accuracy"]


def main() -> int:
    given = sys.argv[1:]
    defaults = ("MA-MLP", "400", "300000", "0,1,2", "10", "3m")
    model, labels, steps, seeds, segment_steps, task = [*given, *defaults[len(given) :]]
    torch.set_num_threads(1)
    print(f"{task}, {model}, {labels} labels, {int(steps):,} steps, T = {segment_steps}")
    print("seed, won, mean return, mean steps, held-out accuracy")
    for seed in map(int, seeds.split(",")):
        learner, accuracy = train(task, model, int(labels), int(steps), seed, int(segment_steps))
        played = play(learner, make(task), EPISODES, seed=12345)
        assert played.successes is not None
        won, mean_return, length = played.successes.mean(), played.returns.mean(), played.lengths.mean()
        print(f"{seed:>4}{won:>6.0%}{mean_return:>8.1f}{length:>7.1f}{accuracy:>8.3f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
