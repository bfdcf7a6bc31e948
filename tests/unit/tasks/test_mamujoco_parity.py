"""Our batched tasks against gymnasium-robotics, from equal states with equal actions."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from pathlib import Path

import numpy as np
import pytest

from mapt.tasks import TaskStep, load_model, make_task
from mapt.tasks.hands import catch, doors
from mapt.tasks.registry import find_definition
from mapt.tasks.robots import porters
from support.mujoco_tasks import MUJOCO_TASKS
from unit.tasks.mamujoco import Reference, assert_close, assert_same_observations

DEPTHS = (0, 1, 2, 5)
#: steps per test, and steps before the horizon at which the episode starts, so that it ends within the test
N_STEPS, STEPS_BEFORE_HORIZON = 100, 70
SEED = 7
#: MaMuJoCo has neither hands nor porters.
OTHERS = {task.name for task in (*catch.TASKS, *doors.TASKS, *porters.TASKS)}
NAMES = tuple(name for name in MUJOCO_TASKS if name not in OTHERS)


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes warnings about deprecated attributes into the working directory."""
    monkeypatch.chdir(tmp_path)


def assert_same_step(ours: TaskStep, theirs: Reference, actions: np.ndarray, action_dims: tuple[int, ...]) -> None:
    step = theirs.step(actions, action_dims)
    assert_close(ours.final_state[0], step.state)
    np.testing.assert_allclose(ours.reward[0], step.reward, rtol=1e-9, atol=1e-9)
    assert (ours.terminated[0], ours.truncated[0]) == (step.terminated, step.truncated)


@pytest.mark.parametrize("name", NAMES)
def test_steps_and_resets_equal_gymnasium_robotics_at_every_agent_obsk(name: str) -> None:
    shared = len(find_definition(name).robot.partition.shared)
    tasks = {
        depth: make_task(name, 1, n_threads=1, agent_obsk=depth, agent_index=False, dtype=np.float64)
        for depth in DEPTHS
    }
    task, theirs = tasks[DEPTHS[0]], Reference(name, DEPTHS)
    spec, rng = task.spec, np.random.default_rng(SEED)

    def start(observations: dict[int, np.ndarray]) -> None:
        qpos, qvel = task.simulator_state()
        theirs.start_from(qpos[0], qvel[0])
        for depth in DEPTHS:
            assert_same_observations(observations[depth][0], theirs.observations(depth), shared)

    start({depth: each.reset(SEED)[0] for depth, each in tasks.items()})
    elapsed = max(0, spec.horizon_steps - STEPS_BEFORE_HORIZON)
    for each in tasks.values():
        each.restore({**each.snapshot(), "elapsed_steps": np.array([elapsed])})
    theirs.set_elapsed_steps(elapsed)

    n_ends = 0
    for _ in range(N_STEPS):
        # Beyond the limit too: MuJoCo clamps the controls, but their cost uses the values before.
        limit = 1.2 * spec.action_limit
        actions = rng.uniform(-limit, limit, (1, spec.n_agents, spec.action_dim))
        steps = {depth: each.step(actions) for depth, each in tasks.items()}
        ours = steps[DEPTHS[0]]
        assert_same_step(ours, theirs, actions[0], spec.agent_action_dims)
        for depth, step in steps.items():
            assert_same_observations(step.final_observations[0], theirs.observations(depth), shared)
        if ours.terminated[0] or ours.truncated[0]:
            n_ends += 1
            start({depth: step.observations for depth, step in steps.items()})
            assert_close(ours.state[0], theirs.state())
    assert n_ends > 0


@pytest.mark.parametrize("name", ["Ant-2x4d", "Humanoid-9|8", "Reacher-2x1"])
def test_single_agent_observes_the_state_and_drives_every_joint(name: str) -> None:
    task = make_task(name, 1, n_threads=1, agent_obsk=None, agent_index=False, dtype=np.float64)
    theirs, rng = Reference(name, (None,)), np.random.default_rng(SEED)
    observations, state = task.reset(SEED)
    np.testing.assert_array_equal(observations[:, 0], state)
    qpos, qvel = task.simulator_state()
    theirs.start_from(qpos[0], qvel[0])
    for _ in range(10):
        actions = rng.uniform(-task.spec.action_limit, task.spec.action_limit, (1, 1, task.spec.action_dim))
        step = task.step(actions)
        assert_same_step(step, theirs, actions[0], task.spec.agent_action_dims)
        (observation,) = theirs.observations(None)
        assert_close(step.final_observations[0, 0], observation)


@pytest.mark.parametrize("name", sorted({name.split("-")[0]: name for name in NAMES}.values()))
def test_initial_states_have_gymnasiums_distribution(name: str) -> None:
    n = 200
    theirs = Reference(name, (0,))
    reference = np.array([theirs.sample_start(seed) for seed in range(n)])
    task = make_task(name, 4_000, n_threads=1)
    task.reset(0)
    ours = np.hstack(task.simulator_state())
    spread = reference.std(axis=0)
    assert (np.abs(ours.mean(axis=0) - reference.mean(axis=0)) <= 5 * spread / np.sqrt(n) + 1e-12).all()
    np.testing.assert_allclose(ours.std(axis=0), spread, rtol=0.3, atol=1e-12)


@pytest.mark.parametrize("name", ["CoupledHalfCheetah-1p1", "ManySegmentAnt-2x2", "ManySegmentSwimmer-2x1"])
def test_assembled_model_equals_gymnasium_robotics_model(name: str) -> None:
    ours, theirs = load_model(name), Reference(name, (0,)).model
    fields = [field for field in dir(theirs) if isinstance(getattr(theirs, field), np.ndarray)]
    physics = [
        field for field in fields if field.startswith(("body_", "jnt_", "dof_", "geom_", "actuator_", "tendon_"))
    ]
    assert len(physics) > 100
    for field in physics:
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), atol=1e-14, err_msg=field)
    for field in ("timestep", "integrator", "viscosity", "density", "gravity", "solver", "iterations"):
        np.testing.assert_array_equal(getattr(ours.opt, field), getattr(theirs.opt, field))
