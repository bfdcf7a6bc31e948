"""Robots that carry a board: the model, what agents observe, the reward and the ends of episodes."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np
import pytest

from mapt.tasks import Task, load_model, make_task
from mapt.tasks.registry import find_definition
from mapt.tasks.robots import porters
from mapt.tasks.robots.porter_models import ANT, HUMANOID, Porter

NAMES = ("Porters-2x8", "Porters-4x8", "Porters-2x17")
every_team = pytest.mark.parametrize("name", NAMES)


def rest(task: Task) -> np.ndarray:
    return np.zeros((task.n_envs, task.spec.n_agents, task.spec.action_dim), dtype=np.float32)


def porter(name: str) -> Porter:
    return HUMANOID if name.endswith("17") else ANT


def terminated(name: str, qpos: np.ndarray) -> bool:
    spec = find_definition(name).spec(agent_obsk=1, agent_index=True)
    features = {"qpos": qpos[None], "qvel": np.zeros((1, spec.nv))}
    return bool(find_definition(name).mdp.terminated(features)[0])  # pyright: ignore[reportAttributeAccessIssue]


@every_team
def test_teams_that_stand_still_carry_the_board_level(name: str) -> None:
    task = make_task(name, 2, n_threads=1)
    task.reset(0)
    for _ in range(60):
        step = task.step(rest(task))
        assert not step.terminated.any()
    qpos, _ = task.simulator_state()
    assert (porters.board_up(qpos) > np.cos(0.1)).all()
    torsos = qpos[:, 2 : -7 : porter(name).nq]
    np.testing.assert_allclose(
        porters.board_position(qpos)[:, 2], torsos.mean(axis=1) + porter(name).board_metres, atol=0.04
    )


@every_team
def test_each_action_drives_the_joint_of_its_agent(name: str) -> None:
    model = load_model(name)
    partition = find_definition(name).robot.partition  # pyright: ignore[reportAttributeAccessIssue]
    for agent, joints in enumerate(partition.agents, start=1):
        for joint in joints:
            assert joint.startswith(f"{porter(name).name}{agent}_")
            assert model.joint(model.actuator_trnid[partition.joint(joint).actuator, 0]).name == joint
            # What is observed as the angle of this joint, and of no other.
            assert partition.joint(joint).near == (("qpos", model.joint(joint).qposadr[0]),)


@every_team
def test_agents_observe_their_own_robot_and_the_way_to_the_board_and_the_others(name: str) -> None:
    task = make_task(name, 1, n_threads=1, agent_obsk=0, agent_index=False, dtype=np.float64)
    task.reset(3)
    for _ in range(5):
        observations = task.step(np.random.default_rng(1).uniform(-1, 1, rest(task).shape)).final_observations[0]
    (qpos,), (qvel,) = task.simulator_state()
    n, board = task.spec.n_agents, qpos[-7:]
    robots, speeds = qpos[:-7].reshape(n, porter(name).nq), qvel[:-6].reshape(n, porter(name).nv)
    for index, seen in enumerate(observations):
        others = [robots[(index + next) % n, :3] - robots[index, :3] for next in range(1, n)]
        expected = [*robots[index, 2:], *speeds[index], *np.ravel([board[:3] - robots[index, :3], *others])]
        np.testing.assert_allclose(seen[-10:], [*board[3:], *qvel[-6:]])
        np.testing.assert_allclose(sorted(seen[:-10]), sorted(expected))


@pytest.mark.parametrize("name", ["Porters-2x8", "Porters-2x17"])
def test_a_neighbour_sees_the_hips_of_ants_and_hips_and_knees_of_humanoids(name: str) -> None:
    near, far = (make_task(name, 1, agent_obsk=k).spec.observation_dim for k in (0, 1))
    assert far == near + 4


@every_team
def test_observations_do_not_depend_on_where_the_team_is(name: str) -> None:
    task = make_task(name, 1, n_threads=1)
    task.reset(0)
    snapshot = task.snapshot()
    here, state = task.restore(snapshot)
    moved = snapshot["qpos"].copy()
    for first in (*range(0, moved.shape[1] - 7, porter(name).nq), moved.shape[1] - 7):
        moved[:, first] += 7.0
        moved[:, first + 1] -= 3.0
    there, other = task.restore(snapshot | {"qpos": moved})
    np.testing.assert_allclose(there, here, atol=1e-6)
    np.testing.assert_allclose(other, state, atol=1e-6)


@every_team
def test_reward_is_speed_of_the_board_plus_a_fifth_less_the_mean_control_cost(name: str) -> None:
    task = make_task(name, 4, n_threads=1)
    task.reset(5)
    actions = np.random.default_rng(2).uniform(-1, 1, rest(task).shape).astype(np.float32)
    before = porters.board_position(task.simulator_state()[0])[:, 0]
    step = task.step(actions)
    after = porters.board_position(task.simulator_state()[0])[:, 0]
    cost = 0.02 * np.square(actions.astype(np.float64)).sum(axis=(1, 2)) / task.spec.n_agents
    np.testing.assert_allclose(step.reward, (after - before) / 0.05 + 0.2 - cost)


@every_team
def test_an_episode_ends_when_the_board_or_a_robot_falls(name: str) -> None:
    standing = find_definition(name).mdp.sample_start(np.random.default_rng(0), 1)[0][0]  # pyright: ignore[reportAttributeAccessIssue]
    assert not terminated(name, standing)
    low, high, board = (0.99, 1.61, 1.04) if porter(name) is HUMANOID else (0.19, 1.01, 0.44)
    second = porter(name).nq + 2
    for index, value in ((-5, board), (2, low), (2, high), (-2, 0.3), (second, low), (7, np.nan)):
        fallen = standing.copy()
        fallen[index] = value
        assert terminated(name, fallen), index


@every_team
def test_an_action_sets_how_far_a_joint_is_from_the_standing_pose(name: str) -> None:
    model = load_model(name)
    model.opt.gravity[:] = 0.0
    model.geom_contype[:] = model.geom_conaffinity[:] = 0
    # Without their grip, humanoids move as freely as ants.
    data = mujoco.MjData(model)
    data.eq_active[:] = 0
    joints = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    standing = porters.TASKS[NAMES.index(name)].mdp.sample_start(np.random.default_rng(0), 1)[0][0]
    data.qpos[:] = standing
    data.ctrl[:] = np.random.default_rng(4).uniform(-0.4, 0.4, model.nu)
    mujoco.mj_step(model, data, 500)
    moved = data.qpos[joints] - standing[joints]
    reach = {f"{servo.joint}": servo.reach_radians for servo in porter(name).servos}
    reaches = [reach[model.joint(joint).name.split("_", 1)[1]] for joint in model.actuator_trnid[:, 0]]
    # The humanoid's joints have springs too.
    np.testing.assert_allclose(moved, reaches * data.ctrl, atol=porters.START_NOISE + 0.015)


@pytest.mark.parametrize("name", ["Porters-2x8", "Porters-2x17"])
def test_untrained_teams_carry_the_board_for_a_second(name: str) -> None:
    task = make_task(name, 8, n_threads=1)
    task.reset(0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        step = task.step(0.6 * rng.standard_normal(rest(task).shape))
        assert not step.terminated.any()


def test_a_board_that_slides_off_ends_the_episode() -> None:
    task = make_task("Porters-2x8", 2, n_threads=1)
    task.reset(0)
    snapshot = task.snapshot()
    snapshot["qpos"][:, -6] += [0.0, 0.7]  # the second board lies beside the saddles
    snapshot["qpos"][:, -5] += 0.2
    task.restore(snapshot)
    for _ in range(60):
        step = task.step(rest(task))
        if step.terminated.any():
            break
    np.testing.assert_array_equal(step.terminated, [False, True])
    assert not step.truncated.any()
