"""The adapter to SMAC, on a fake with the methods that it uses."""

import sys
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest

from mapt.errors import InvalidAction, InvalidSnapshot, NoSimulator, UnusableEnvironment
from mapt.policies import Learner, PolicyConfig
from mapt.tasks import MaskingTask, load_model, make_task, task_names, task_spec
from mapt.tasks.smac_task import SmacTask

LIMIT = 4


class FakeStarCraft2Env:
    """Two agents with three actions. The battle is won when both choose action 2; a seeded number is observed."""

    made: ClassVar[list["FakeStarCraft2Env"]] = []

    def __init__(self, map_name: str, seed: int) -> None:
        if map_name != "2m":
            raise KeyError(map_name)
        self.seed, self.steps, self.closed, self.battles = seed, 0, False, 0
        self.made.append(self)

    def get_env_info(self) -> dict[str, Any]:
        return {"n_agents": 2, "obs_shape": 3, "state_shape": 2, "n_actions": 3, "episode_limit": LIMIT}

    def reset(self) -> None:
        self.steps, self.battles = 0, self.battles + 1

    def step(self, actions: list[int]) -> tuple[float, bool, dict[str, Any]]:
        self.steps += 1
        won = actions == [2, 2]
        limited = not won and self.steps == LIMIT
        return float(sum(actions)), won or limited, {"battle_won": won} | ({"episode_limit": True} if limited else {})

    def get_obs(self) -> list[np.ndarray]:
        return [np.array([agent, self.steps, self.seed % 7], np.float32) for agent in range(2)]

    def get_state(self) -> np.ndarray:
        return np.array([self.steps, self.battles], np.float32)

    def get_avail_actions(self) -> list[list[int]]:
        return [[1, 1, int(self.steps > 0)], [1, 1, 1]]

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    package, module = ModuleType("smac"), ModuleType("smac.env")
    module.StarCraft2Env = FakeStarCraft2Env  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "smac", package)
    monkeypatch.setitem(sys.modules, "smac.env", module)
    monkeypatch.setenv("SC2PATH", str(tmp_path))
    monkeypatch.setattr(FakeStarCraft2Env, "made", [])


def make(n_envs: int = 2) -> SmacTask:
    task = make_task("SMAC-2m", n_envs)
    assert isinstance(task, SmacTask)
    return task


def actions(*chosen: tuple[int, int]) -> np.ndarray:
    return np.eye(3, dtype=np.float32)[np.array(chosen)]


@pytest.mark.usefixtures("installed")
def test_episodes_end_by_victory_or_at_the_limit_and_start_again() -> None:
    task = make()
    assert isinstance(task, MaskingTask)
    observations, state = task.reset(3)
    assert observations.shape == (2, 2, task.spec.observation_dim) == (2, 2, 5)
    assert observations[0, :, 3:].tolist() == [[1, 0], [0, 1]]
    assert state.tolist() == [[0, 1], [0, 1]]
    assert task.available_actions().tolist() == [[[True, True, False], [True] * 3]] * 2

    step = task.step(actions((1, 0), (0, 0)))
    assert (step.reward.tolist(), step.terminated.any(), step.truncated.any()) == ([1.0, 0.0], False, False)
    step = task.step(actions((2, 2), (0, 0)))
    assert (step.terminated.tolist(), step.truncated.tolist()) == ([True, False], [False, False])
    assert step.success is not None
    assert step.success.tolist() == [True, False]
    assert (step.final_state.tolist(), step.state.tolist()) == ([[2, 1], [2, 1]], [[0, 2], [2, 1]])
    for _ in range(LIMIT - 2):
        step = task.step(actions((0, 0), (0, 1)))
    assert (step.terminated.tolist(), step.truncated.tolist()) == ([False, False], [False, True])
    with pytest.raises(InvalidAction):
        task.step(actions((0, 0)))


@pytest.mark.usefixtures("installed")
def test_each_environment_has_a_seed_of_its_own_and_games_end() -> None:
    task = make()
    task.reset(5)
    seeds = [env.seed for env in FakeStarCraft2Env.made[-2:]]
    assert seeds[0] != seeds[1]
    task.reset(5)
    assert [env.seed for env in FakeStarCraft2Env.made[-2:]] == seeds
    assert [env.closed for env in FakeStarCraft2Env.made[-4:]] == [True, True, False, False]
    task.close()
    assert all(env.closed for env in FakeStarCraft2Env.made[-4:])
    with pytest.raises(InvalidSnapshot, match="cannot be resumed"):
        task.restore(task.snapshot())
    with pytest.raises(NoSimulator):
        load_model("SMAC-2m")


@pytest.mark.usefixtures("installed")
def test_a_policy_trains_on_it() -> None:
    config = PolicyConfig(n_envs=2, rollout_steps=8, minibatches=1, epochs=1, hidden=(4,), device="cpu")
    learner = Learner(make(), config)
    rollout = learner.collect()
    assert rollout.available_actions is not None
    assert (rollout.actions <= rollout.available_actions).all()
    learner.update(rollout, rollout.rewards)


@pytest.mark.usefixtures("installed")
def test_a_map_that_smac_does_not_have_is_named() -> None:
    with pytest.raises(UnusableEnvironment, match="no map called '9m'"):
        task_spec("SMAC-9m")


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert not any(name.startswith("SMAC") for name in task_names())
    monkeypatch.setenv("SC2PATH", str(tmp_path / "absent"))
    with pytest.raises(UnusableEnvironment, match="name its folder in SC2PATH"):
        task_spec("SMAC-2m")
    monkeypatch.setenv("SC2PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "smac.env", None)
    with pytest.raises(UnusableEnvironment, match="needs SMAC, which cannot be imported"):
        task_spec("SMAC-2m")
