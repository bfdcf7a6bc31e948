"""Our batched cheetahs against gymnasium-robotics' own, from the same states and actions."""

from pathlib import Path

import numpy as np
import pytest
from gymnasium_robotics import mamujoco_v1

from mapt.tasks import Task, TaskStep, make_task

SEEDS = (0, 1, 2)
#: One episode of 1,000 steps and the first steps after the automatic reset.
N_STEPS = 1_010
TOLERANCE = 1e-9


class Reference:
    """One gymnasium-robotics environment that follows one of ours."""

    def __init__(self, conf: str, agent_obsk: int) -> None:
        self.env = mamujoco_v1.parallel_env("HalfCheetah", conf, agent_obsk=agent_obsk)

    def start_from(self, qpos: np.ndarray, qvel: np.ndarray) -> list[np.ndarray]:
        self.env.reset(seed=0)
        self.env.single_agent_env.unwrapped.set_state(qpos, qvel)
        return list(self.env._get_obs().values())

    def step(self, actions: np.ndarray) -> tuple[list[np.ndarray], np.ndarray, float, bool, bool]:
        observations, rewards, terminations, truncations, _ = self.env.step(
            dict(zip(self.env.possible_agents, actions, strict=True))
        )
        first = self.env.possible_agents[0]
        state = self.env.state()
        return (
            list(observations.values()),
            state,
            float(rewards[first]),
            bool(terminations[first]),
            bool(truncations[first]),
        )


def without_padding(observation: np.ndarray, reference: np.ndarray, n_shared: int = 5) -> np.ndarray:
    """Our observation with the zeros of missing neighbours, which stand before the shared part, taken out."""
    n_missing = observation.size - reference.size
    end = observation.size - n_shared
    np.testing.assert_array_equal(observation[end - n_missing : end], 0.0)
    return np.delete(observation, np.s_[end - n_missing : end])


def assert_same_observations(ours: np.ndarray, theirs: list[np.ndarray]) -> None:
    for observation, reference in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(without_padding(observation, reference), reference, rtol=0, atol=TOLERANCE)


def assert_same_step(env: int, ours: TaskStep, reference: Reference, actions: np.ndarray) -> None:
    observations, state, reward, terminated, truncated = reference.step(actions)
    assert_same_observations(ours.final_observations[env], observations)
    np.testing.assert_allclose(ours.final_state[env], state, rtol=0, atol=TOLERANCE)
    assert ours.reward[env] == pytest.approx(reward, rel=0, abs=TOLERANCE)
    assert (ours.terminated[env], ours.truncated[env]) == (terminated, truncated)


def follow(reference: Reference, task: Task, env: int, observations: np.ndarray) -> None:
    qpos, qvel = task.simulator_state()
    assert_same_observations(observations[env], reference.start_from(qpos[env], qvel[env]))


@pytest.mark.parametrize("agent_obsk", [0, 1, 2])
@pytest.mark.parametrize("conf", ["6x1", "2x3"])
def test_thousand_steps_equal_gymnasium_robotics_across_the_reset(
    conf: str, agent_obsk: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # MuJoCo also writes its complaint about the attribute into the working directory.
    monkeypatch.chdir(tmp_path)
    task = make_task(f"HalfCheetah-{conf}", len(SEEDS), agent_obsk=agent_obsk, agent_index=False, dtype=np.float64)
    references = [Reference(conf, agent_obsk) for _ in SEEDS]
    draws = [np.random.default_rng(seed) for seed in SEEDS]
    observations, _ = task.reset(seed=7)
    for env, reference in enumerate(references):
        follow(reference, task, env, observations)

    for t in range(N_STEPS):
        # Beyond the limit too: the controls are clamped, their cost is not.
        actions = np.stack([rng.uniform(-1.2, 1.2, (task.spec.n_agents, task.spec.action_dim)) for rng in draws])
        step = task.step(actions)
        for env, reference in enumerate(references):
            assert_same_step(env, step, reference, actions[env])
        assert step.truncated.all() == (t + 1 == task.spec.horizon_steps)
        for env in np.flatnonzero(step.truncated):
            follow(references[env], task, int(env), step.observations)
