"""Stored segments of a task that are small enough for a test."""

from pathlib import Path

import numpy as np
import torch

from mapt.benchmarks.recorded_dataset import append_segments, draw_step_ranges, layout_of
from mapt.policies import Learner, PolicyConfig
from mapt.policies.rollout import Collector
from mapt.preferences.storage import SegmentWriter
from mapt.tasks import make_task
from support.short_tasks import SHORTEST_HORIZON_STEPS, SHORTEST_NAME

SEGMENT_STEPS = 10


def write_segments(path: Path, segments: int = 24, seed: int = 0, task_name: str = SHORTEST_NAME) -> Path:
    """Record segments of an untrained policy."""
    config = PolicyConfig(n_envs=4, rollout_steps=8, minibatches=1, hidden=(8,), seed=seed)
    task = make_task(task_name, 4)
    try:
        policy = Learner(task, config).policy
        rollout = Collector(task, seed).collect(policy, 8 * SHORTEST_HORIZON_STEPS, torch.Generator().manual_seed(seed))
    finally:
        task.close()
    about = {"task": task_name, "seed": seed}
    with SegmentWriter.create(path, layout_of(task.spec, SEGMENT_STEPS), about=about) as writer:
        rng = np.random.default_rng(seed)
        append_segments(writer, rollout, draw_step_ranges(rollout, SEGMENT_STEPS, segments, rng))
    return path
