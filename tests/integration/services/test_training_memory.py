"""The estimate of the memory of a training, against real trainings, and the refusal of what does not fit."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from accord.domain.errors import InvalidExperiment
from accord.services import training_memory
from accord.services.experiment_config import ExperimentConfig
from accord.services.training_memory import MemoryLimit, machine_bytes, require_fits
from mapt.rewards.relabelling import AGENT_STEPS_PER_PASS
from mapt.rewards.stage_trainer import ACTIVATIONS_PER_PASS
from mapt.tasks import task_spec
from support.waiting import PATIENCE_SECONDS

pytestmark = pytest.mark.slow

TASK = "HalfCheetah-6x1"
SPEC = task_spec(TASK)
#: an estimate is at least half of the measured peak and at most twice as much
FACTOR = 2.0


def measured_bytes(what: str, settings: dict[str, Any]) -> int:
    """The peak of a training in a process of its own."""
    command = [sys.executable, str(Path(__file__).with_name("training_peak.py")), what, json.dumps(settings)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return int(
        subprocess.run(command, env=environment, check=True, capture_output=True, timeout=PATIENCE_SECONDS).stdout
    )


@pytest.mark.parametrize(
    "policy",
    [
        {"n_envs": 512, "rollout_steps": 64},
        {"n_envs": 128, "rollout_steps": 64, "minibatches": 1, "hidden": [512, 512]},
        {"n_envs": 64, "rollout_steps": 64, "minibatches": 1, "algorithm": "mat"},
    ],
)
def test_estimate_of_the_policy_is_near_its_peak(policy: dict[str, Any]) -> None:
    settings = {"task": TASK, "reward_source": "true", "policy": policy | {"epochs": 1}}
    measured = measured_bytes("policy", settings)
    estimate = training_memory.training_memory(ExperimentConfig.from_dict(settings), SPEC).policy_bytes
    assert measured / FACTOR < estimate < measured * FACTOR


@pytest.mark.parametrize(
    "settings",
    [
        {"label_budget": 400},
        {"label_budget": 16, "initial_labels": 8, "reward_preset": "paper"},
    ],
)
def test_estimate_of_the_reward_model_is_near_its_peak(settings: dict[str, Any]) -> None:
    settings = {"task": TASK} | settings
    measured = measured_bytes("reward", settings)
    estimate = training_memory.training_memory(ExperimentConfig.from_dict(settings), SPEC).reward_bytes
    assert measured / FACTOR < estimate < measured * FACTOR


def test_passes_are_as_large_as_those_of_the_library() -> None:
    assert training_memory.TRAINED_ACTIVATIONS_PER_PASS == ACTIVATIONS_PER_PASS
    assert training_memory.RELABELLED_AGENT_STEPS_PER_PASS == AGENT_STEPS_PER_PASS


def test_default_experiment_fits_in_two_gigabytes() -> None:
    for algorithm in ("mappo", "happo", "mat", "mat_dec"):
        require_fits(ExperimentConfig(TASK, policy={"algorithm": algorithm}), SPEC, MemoryLimit(2 * 10**9))
    assert machine_bytes() > 10**9


@pytest.mark.parametrize(
    ("settings", "processes"),
    [
        ({"reward_model": "MA-MLP"}, 1),  # a single network
        ({}, 5),  # after the first network the four others, side by side
        ({"reward_model": "MA-MLP", "query_selection": "entropy", "ensemble_members": 3}, 4),
    ],
)
def test_processes_that_train_at_the_same_time_count(settings: dict[str, Any], processes: int) -> None:
    config = ExperimentConfig.from_dict({"task": TASK} | settings)
    one, many = (training_memory.training_memory(config, SPEC, limit) for limit in (1, 16))
    assert (one.reward_processes, many.reward_processes) == (1, processes)
    further = (processes - 1) * (many.reward_bytes + training_memory.PROCESS_BYTES)
    assert many.total_bytes == one.total_bytes + further
    if further:
        with pytest.raises(InvalidExperiment, match="GB of memory"):
            require_fits(config, SPEC, MemoryLimit(one.total_bytes, reward_processes=16))
    require_fits(config, SPEC, MemoryLimit(one.total_bytes))


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"policy": {"n_envs": 8192, "rollout_steps": 4096}}, "policy.n_envs"),
        ({"policy": {"rollout_steps": 100_000, "n_envs": 1024}}, "policy.rollout_steps"),
        ({"policy": {"hidden": [8192, 8192, 8192]}}, "policy.hidden"),
        ({"policy": {"algorithm": "mat", "width": 8192, "layers": 8}}, "policy.width"),
        ({"label_budget": 10_000_000}, "label_budget"),
    ],
)
def test_error_for_a_training_that_does_not_fit_names_the_setting(settings: dict[str, Any], field: str) -> None:
    config = ExperimentConfig.from_dict({"task": TASK} | settings)
    with pytest.raises(InvalidExperiment, match=r"\d GB of memory; the limit is 16.0 GB") as raised:
        require_fits(config, SPEC, MemoryLimit(16 * 10**9))
    assert raised.value.field == field
