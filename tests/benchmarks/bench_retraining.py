"""Seconds until a new reward version is trained, by teacher and number of labels.

Each version continues from the one before, as in the service. `oracle` judges by the return, which the Markov path
learns; `recency` judges by the last steps, which needs attention: a version tries the attention path when the labels
have grown enough, and trains the whole network once it is in use. The segments come from a policy that learns the task.

    python tests/benchmarks/bench_retraining.py [--labels 200 250 300] [--teachers oracle recency] [--threads 1]
        [--workers 1]
"""

import argparse
import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from mapt.benchmarks.evaluate import DatasetTeacher, label_pairs
from mapt.benchmarks.recorded_dataset import RecordedDataset, Recording, record_dataset
from mapt.rewards.attention_trial import IN_USE, TRIAL_LABELS
from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.trainer import TrainedReward, train_reward_model

TASK = "HalfCheetah-6x1"
SEGMENT_STEPS = 50
POLICY_STEPS = 100_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labels", type=int, nargs="+", default=[200, 250, 300])
    parser.add_argument("--teachers", nargs="+", default=["oracle", "recency"])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1, help="processes that train networks at the same time")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    with TemporaryDirectory() as folder:
        recording = Recording(TASK, POLICY_STEPS, SEGMENT_STEPS, segments=4 * max(arguments.labels), seed=0)
        dataset = record_dataset(recording, Path(folder) / "segments")
        for teacher in arguments.teachers:
            train_versions(dataset, teacher, sorted(arguments.labels), arguments.workers)


def train_versions(dataset: RecordedDataset, teacher: str, counts: list[int], workers: int) -> None:
    """Train one version for each number of labels and print what each took."""
    labelled = label_pairs(DatasetTeacher(teacher, dataset, seed=0), dataset, counts[-1], seed=0)
    spec = dataset.segments([0])
    n_agents, observation_dim = spec.observations.shape[2:]
    config = RewardConfig.named(
        "MAPT",
        observation_dim=observation_dim,
        action_dim=spec.actions.shape[3],
        n_agents=n_agents,
        segment_steps=SEGMENT_STEPS,
    )
    previous: TrainedReward | None = None
    for count in counts:
        wall, cpu = time.perf_counter(), cpu_seconds()
        trained = train_reward_model(
            labelled.first(count).dataset(dataset),
            config,
            TrainConfig(),
            initial=previous.model if previous else None,
            initial_metrics=previous.metrics if previous else None,
            workers=workers,
        )
        wall, cpu = time.perf_counter() - wall, cpu_seconds() - cpu
        tried = trained.metrics.get(TRIAL_LABELS) == count
        state = "in use" if trained.metrics[IN_USE] else "rejected" if tried else "not tried"
        print(
            f"{teacher:8} {count:5} labels: {wall:6.1f} s, {cpu:6.1f} s of CPU time; {trained.metrics['epochs']:3.0f}"
            f" epochs, attention {state}",
            flush=True,
        )
        previous = trained


def cpu_seconds() -> float:
    """CPU time of this process and of its ended children."""
    return sum(os.times()[:4])


if __name__ == "__main__":
    main()
