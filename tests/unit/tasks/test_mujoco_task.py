"""Batches of MuJoCo environments: initial states, resets, snapshots, observations and actions."""

import numpy as np
import pytest

from mapt.errors import InvalidAction, InvalidConfig, InvalidSnapshot, MissingFeatures, UnknownTask
from mapt.tasks import MujocoDefinition, Task, TaskStep, agent_geoms, load_model, make_task, task_names, task_spec
from mapt.tasks.registry import find_definition
from support.mujoco_tasks import MUJOCO_TASKS

NAME = "HalfCheetah-6x1"


def random_actions(task: Task, seed: int, n_steps: int) -> np.ndarray:
    shape = (n_steps, task.n_envs, task.spec.n_agents, task.spec.action_dim)
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


def play(task: Task, actions: np.ndarray) -> list[TaskStep]:
    return [task.step(action) for action in actions]


def assert_same_steps(ours: list[TaskStep], theirs: list[TaskStep]) -> None:
    for one, other in zip(ours, theirs, strict=True):
        for name in TaskStep.__slots__:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("name", MUJOCO_TASKS)
@pytest.mark.parametrize("agent_obsk", [0, 1])
@pytest.mark.parametrize("agent_index", [True, False])
def test_arrays_have_the_shapes_of_the_spec(name: str, agent_obsk: int, agent_index: bool) -> None:
    task = make_task(name, 3, agent_obsk=agent_obsk, agent_index=agent_index)
    spec = task_spec(name, agent_obsk=agent_obsk, agent_index=agent_index)
    assert task.spec == spec
    assert len(spec.agent_names) == spec.n_agents

    observations, state = task.reset(0)
    step = task.step(np.zeros((3, spec.n_agents, spec.action_dim), dtype=np.float32))
    qpos, qvel = task.simulator_state()

    for array in (observations, step.observations, step.final_observations):
        assert (array.shape, array.dtype) == ((3, spec.n_agents, spec.observation_dim), np.float32)
    for array in (state, step.state, step.final_state):
        assert (array.shape, array.dtype) == ((3, spec.state_dim), np.float32)
    assert (step.reward.shape, step.reward.dtype) == ((3,), np.float64)
    assert step.terminated.dtype == step.truncated.dtype == np.bool_
    assert (qpos.shape, qvel.shape) == ((3, spec.nq), (3, spec.nv))


def test_model_has_the_sizes_of_the_spec() -> None:
    model = load_model(NAME)
    assert (model.nq, model.nv) == (task_spec(NAME).nq, task_spec(NAME).nv)
    assert model.opt.timestep * 5 == pytest.approx(task_spec(NAME).step_seconds)


@pytest.mark.parametrize(("name", "can_terminate"), [(NAME, False), ("Hopper-3x1", True), ("Ant-4x2", True)])
def test_spec_says_whether_episodes_can_terminate(name: str, can_terminate: bool) -> None:
    assert task_spec(name).can_terminate == can_terminate


def test_observations_end_with_the_agent_index() -> None:
    observations, _ = make_task(NAME, 2).reset(0)
    np.testing.assert_array_equal(observations[:, :, -6:], np.broadcast_to(np.eye(6), (2, 6, 6)))


def test_seed_determines_the_episodes() -> None:
    first, second, third = (make_task(NAME, 4) for _ in range(3))
    start = first.reset(5)[0]
    np.testing.assert_array_equal(start, second.reset(5)[0])
    assert not np.array_equal(start, third.reset(6)[0])
    assert len(np.unique(start[:, 0, 0])) == 4
    actions = random_actions(first, 0, 20)
    assert_same_steps(play(first, actions), play(second, actions))


def test_number_of_threads_does_not_change_results() -> None:
    one, two = make_task(NAME, 5, n_threads=1), make_task(NAME, 5, n_threads=2)
    one.reset(0)
    two.reset(0)
    actions = random_actions(one, 1, 50)
    assert_same_steps(play(one, actions), play(two, actions))


def test_initial_states_have_the_noise_of_the_mdp() -> None:
    task = make_task(NAME, 4_000)
    task.reset(0)
    qpos, qvel = task.simulator_state()
    assert np.abs(qpos).max() <= 0.1
    assert qpos.std() == pytest.approx(0.1 / np.sqrt(3), rel=0.02)
    assert qvel.std() == pytest.approx(0.1, rel=0.02)


def test_episode_is_truncated_at_the_horizon_and_the_next_starts() -> None:
    task = make_task(NAME, 2)
    task.reset(0)
    actions = random_actions(task, 2, 2_000)
    steps = play(task, actions)
    truncated = [t for t, step in enumerate(steps) if step.truncated.any()]
    assert truncated == [999, 1999]
    assert all(steps[t].truncated.all() and not steps[t].terminated.any() for t in truncated)
    # Initial states are near rest; final states after random torques are not.
    assert np.abs(steps[999].state).max() < 0.6
    assert np.abs(steps[999].final_state).max() > 0.6
    np.testing.assert_array_equal(steps[998].observations, steps[998].final_observations)


def test_simulator_state_matches_the_current_observations() -> None:
    task = make_task(NAME, 2, dtype=np.float64)
    task.reset(0)
    for action in random_actions(task, 3, 1_001):
        step = task.step(action)
        qpos, qvel = task.simulator_state()
        np.testing.assert_array_equal(np.hstack([qpos[:, 1:], qvel]), step.state)


@pytest.mark.parametrize("n_steps_before", [0, 1, 7, 993])
def test_restored_task_continues_bit_for_bit_through_the_next_reset(n_steps_before: int) -> None:
    task, other = make_task(NAME, 3), make_task(NAME, 3)
    task.reset(0)
    other.reset(99)
    play(task, random_actions(task, 4, n_steps_before))
    play(other, random_actions(other, 5, 3))
    snapshot = task.snapshot()
    actions = random_actions(task, 6, 1_010)
    expected = play(task, actions)

    observations, state = other.restore(snapshot)

    qpos, qvel = other.simulator_state()
    np.testing.assert_array_equal(qpos, snapshot["qpos"])
    np.testing.assert_array_equal(np.hstack([qpos[:, 1:], qvel]).astype(np.float32), state)
    assert observations.shape == (3, 6, task.spec.observation_dim)
    assert_same_steps(play(other, actions), expected)


def test_snapshot_of_another_batch_is_rejected() -> None:
    snapshot = make_task(NAME, 3).snapshot()
    with pytest.raises(InvalidSnapshot):
        make_task(NAME, 4).restore(snapshot)
    del snapshot["time"]
    with pytest.raises(InvalidSnapshot):
        make_task(NAME, 3).restore(snapshot)


@pytest.mark.parametrize("shape", [(2, 6), (2, 1, 6), (3, 6, 1), (6, 1)])
def test_actions_of_wrong_shape_are_rejected(shape: tuple[int, ...]) -> None:
    task = make_task(NAME, 2)
    task.reset(0)
    with pytest.raises(InvalidAction):
        task.step(np.zeros(shape))


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_action_that_is_not_finite_is_rejected_before_the_physics(number: float) -> None:
    task = make_task(NAME, 2)
    task.reset(0)
    before = task.snapshot()
    actions = np.zeros((2, 6, 1))
    actions[1, 3] = number
    with pytest.raises(InvalidAction):
        task.step(actions)
    for name, field in task.snapshot().items():
        np.testing.assert_array_equal(field, before[name])


def test_unknown_task_error_lists_the_known_tasks() -> None:
    for use in (lambda name: make_task(name, 1), task_spec, load_model, agent_geoms):
        with pytest.raises(UnknownTask) as error:
            use("HalfCheetah-7x1")
        assert {"HalfCheetah-2x3", "HalfCheetah-6x1"} <= set(error.value.known)


@pytest.mark.parametrize(("field", "value"), [("n_envs", 0), ("n_threads", -1), ("agent_obsk", -1)])
def test_options_out_of_range_are_rejected(field: str, value: int) -> None:
    with pytest.raises(InvalidConfig) as error:
        make_task(NAME, **{"n_envs": 1, field: value})
    assert error.value.field == field


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (NAME, [["bthigh"], ["bshin"], ["bfoot"], ["fthigh"], ["fshin"], ["ffoot"]]),
        ("HalfCheetah-2x3", [["bthigh", "bshin", "bfoot"], ["fthigh", "fshin", "ffoot"]]),
    ],
)
def test_geoms_belong_to_the_agent_that_moves_them(name: str, expected: list[list[str]]) -> None:
    model = load_model(name)
    assert [[model.geom(geom).name for geom in geoms] for geoms in agent_geoms(name)] == expected


@pytest.mark.parametrize(
    "name", ["Ant-4x2", "CoupledHalfCheetah-1p1", "Humanoid-9|8", "Reacher-2x1", "CatchOver2Underarm", "DoorOpenInward"]
)
def test_snapshot_includes_fields_of_the_last_step(name: str) -> None:
    task, other = make_task(name, 2, n_threads=1), make_task(name, 2, n_threads=1)
    task.reset(0)
    other.reset(99)
    before = play(task, random_actions(task, 4, 30))[-1]
    snapshot = task.snapshot()
    actions = random_actions(task, 6, 60)
    expected = play(task, actions)

    observations, state = other.restore(snapshot)

    np.testing.assert_array_equal(observations, before.observations)
    np.testing.assert_array_equal(state, before.state)
    assert_same_steps(play(other, actions), expected)


def test_padding_of_actions_is_ignored() -> None:
    task = make_task("Humanoid-9|8", 1, n_threads=1)
    assert task.spec.agent_action_dims == (9, 8)
    task.reset(0)
    snapshot = task.snapshot()
    actions = random_actions(task, 0, 1)[0]
    first = task.step(actions)
    actions[:, 1, 8] += 1.0
    task.restore(snapshot)
    assert_same_steps([task.step(actions)], [first])


def test_many_segment_robots_exist_in_any_size() -> None:
    spec = task_spec("ManySegmentSwimmer-4x3")
    assert (spec.n_agents, spec.action_dim, spec.nq) == (4, 3, 15)
    assert spec.name not in task_names()
    for name in ("ManySegmentSwimmer-1x1", "ManySegmentAnt-0x2", "ManySegmentAnt-2", "ManySegmentAnt-100x2"):
        with pytest.raises(UnknownTask):
            task_spec(name)


@pytest.mark.parametrize("name", MUJOCO_TASKS)
def test_every_agent_moves_geoms(name: str) -> None:
    geoms = agent_geoms(name)
    assert len(geoms) == task_spec(name).n_agents
    assert all(geoms)


def test_geom_moved_by_several_agents_belongs_to_each() -> None:
    model, geoms = load_model("Humanoid-17x1"), agent_geoms("Humanoid-17x1")
    names = task_spec("Humanoid-17x1").agent_names
    thigh = model.geom("right_thigh1").id
    assert [name for name, own in zip(names, geoms, strict=True) if thigh in own] == [
        "right hip x",
        "right hip y",
        "right hip z",
    ]


def test_welded_geoms_belong_to_the_agent_of_their_limb() -> None:
    model = load_model("Humanoid-9|8")
    _, legs = agent_geoms("Humanoid-9|8")
    assert {model.geom(f"{side}_foot").id for side in ("left", "right")} <= set(legs)


@pytest.mark.parametrize(
    ("name", "agent_index"), [*((name, True) for name in MUJOCO_TASKS if name != "Reacher-2x1"), (NAME, False)]
)
def test_vectors_of_the_whole_team_are_split_among_its_agents(name: str, agent_index: bool) -> None:
    """The agents' task makes the same steps with the split actions, and observes the split observations."""
    definition = find_definition(name)
    assert isinstance(definition, MujocoDefinition)
    whole = make_task(name, 2, n_threads=1, agent_obsk=None, agent_index=False)
    team = make_task(name, 2, n_threads=1, agent_obsk=1, agent_index=agent_index)
    joint, _ = whole.reset(0)
    expected, _ = team.reset(0)
    for actions in random_actions(whole, seed=1, n_steps=2):
        split, split_actions = definition.split_joint(
            joint[:, 0], actions[:, 0], whole.simulator_state(), agent_obsk=1, agent_index=agent_index
        )
        np.testing.assert_array_equal(split, expected)
        joint, expected = whole.step(actions).observations, team.step(split_actions).observations


@pytest.mark.parametrize(("name", "feature"), [("Walker2d-2x3", "qvel"), ("Reacher-2x1", "offset")])
def test_what_the_whole_team_does_not_observe_is_not_made_up(name: str, feature: str) -> None:
    definition, spec = find_definition(name), task_spec(name, agent_obsk=None, agent_index=False)
    assert isinstance(definition, MujocoDefinition)
    joint = np.zeros((3, spec.observation_dim)), np.zeros((3, spec.action_dim))
    with pytest.raises(MissingFeatures) as refused:
        definition.split_joint(*joint, agent_obsk=1, agent_index=True)
    assert refused.value.features == (feature,)
