"""Learn HalfCheetah from preferences without a server: an oracle labels pairs of segments, MAPT learns the reward.

python docs/examples/preference_loop.py [environment steps] [labels] [folder for `mapt curves`]
"""

import sys
from pathlib import Path

from mapt.policies import Learner, PolicyConfig
from mapt.preferences import OracleTeacher
from mapt.tasks import make_task
from mapt.training.preference_loop import PreferenceLoop, RewardSettings
from mapt.training.schedule import LabelSchedule


def report(metrics: dict[str, float]) -> None:
    """One line for each iteration in which episodes ended."""
    if "true_return" in metrics:
        print("{steps:>9,} steps  {labels:>4} labels  version {reward_version}  ".format(**metrics), end="")
        print(f"true return {metrics['true_return']:,.0f}", flush=True)


def main(total_steps: int = 1_000_000, labels: int = 500, *, output: Path | None = None) -> PreferenceLoop:
    """Train and return the loop, which holds the policy, the queries and the reward versions."""
    task = make_task("HalfCheetah-6x1", n_envs=8)
    loop = PreferenceLoop(
        Learner(task, PolicyConfig(n_envs=8, seed=0)),
        OracleTeacher(),
        LabelSchedule(labels, initial=max(2, labels // 5), total_steps=total_steps),
        RewardSettings(segment_steps=50, seed=0),
        on_iteration=report,
        output=output,
    )
    loop.run()
    task.close()
    return loop


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]), output=Path(sys.argv[3]) if len(sys.argv) > 3 else None)
