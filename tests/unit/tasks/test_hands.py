"""Two Shadow hands: observations, rewards, ends and mirror symmetry, each beside MuJoCo's own numbers."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mapt.tasks import load_model, make_task, task_spec
from mapt.tasks.hands import catch, doors
from mapt.tasks.hands.model import FINGERS, SIDES, Pose, Strength, joint_limits, two_hands
from mapt.tasks.hands.observation import relative_quaternion, write_roll_pitch_yaw
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.registry import find_definition

CATCH, INWARD, OUTWARD, CLOSE = "CatchOver2Underarm", "DoorOpenInward", "DoorOpenOutward", "DoorCloseOutward"
DOORS = (INWARD, OUTWARD, CLOSE)
NAMES = (CATCH, *DOORS)
STORED = Path(__file__).parent / "stored"
MIRROR = np.array([1.0, -1.0, 1.0])


class Probe:
    """One simulation in a random state, and the features that the task computes from its sensors."""

    def __init__(self, name: str, seed: int) -> None:
        definition = find_definition(name)
        assert isinstance(definition, MujocoDefinition)
        self.mdp, self.model = definition.mdp, load_model(name)
        self.data = mujoco.MjData(self.model)
        rng = np.random.default_rng(seed)
        qpos, _ = self.mdp.sample_start(rng, 1)
        velocities = rng.normal(0, 0.5, self.model.nv)
        mujoco.mj_integratePos(self.model, qpos[0], rng.normal(0, 0.3, self.model.nv), 1.0)
        self.data.qpos[:], self.data.qvel[:] = qpos[0], velocities
        self.data.ctrl[:] = rng.uniform(-1.5, 1.5, self.model.nu)
        mujoco.mj_forward(self.model, self.data)
        layout = self.mdp.layout(self.model.nq, self.model.nv)
        self.features = layout.views(np.zeros((1, layout.width)))
        for field in ("qpos", "qvel", *self.mdp.fields):
            self.features[field][0] = getattr(self.data, field)
        self.mdp.compute(self.features)

    def reward(self) -> float:
        return float(self.mdp.reward({}, self.features, self.data.ctrl[None])[0])

    def terminated(self) -> bool:
        return bool(self.mdp.terminated(self.features)[0])

    def velocity(self, body: str) -> np.ndarray:
        """Linear, then angular velocity of a body's frame in world coordinates."""
        both = np.zeros(6)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_XBODY, self.data.body(body).id, both, False)
        return np.concatenate([both[3:], both[:3]])


@pytest.mark.parametrize(
    ("name", "observed", "state", "horizon"),
    [(CATCH, 223, 422, 75), (INWARD, 218, 417, 250), (OUTWARD, 218, 417, 250), (CLOSE, 218, 417, 250)],
)
def test_dimensions_are_those_of_bidexhands(name: str, observed: int, state: int, horizon: int) -> None:
    spec, model = task_spec(name, agent_index=False), load_model(name)
    assert (spec.n_agents, spec.action_dim, spec.observation_dim, spec.state_dim) == (2, 26, observed, state)
    assert (spec.horizon_steps, spec.can_terminate) == (horizon, True)
    assert (spec.nq, spec.nv) == (model.nq, model.nv)
    assert spec.step_seconds == pytest.approx(1 / 60)
    assert model.opt.timestep == pytest.approx(1 / 240)
    assert {spec.observation_dim for spec in (task_spec(name, agent_obsk=k, agent_index=False) for k in (0, 5))} == {
        observed
    }


@pytest.mark.parametrize("name", NAMES)
def test_actions_drive_the_actuators_of_their_own_hand_in_order(name: str) -> None:
    task, model = make_task(name, 1, n_threads=1), load_model(name)
    actions = np.arange(52).reshape(1, 2, 26) / 52
    task.reset(0)
    task.step(actions)
    ctrl = task.snapshot()["ctrl"][0]
    for hand, side in enumerate(SIDES):
        targets = [
            model.actuator(i).name for i in range(model.nu) if model.actuator(i).name.startswith(f"{side}_robot")
        ]
        order = [f"{side}_{kind}_{axis}" for kind in ("force", "torque") for axis in "xyz"] + targets
        assert len(order) == 26
        np.testing.assert_array_equal([ctrl[model.actuator(i).id] for i in order], actions[0, hand])


@pytest.mark.parametrize(("name", "force", "torque"), [(CATCH, 166.67, 33.33), (INWARD, 833.3, 8.333)])
def test_forces_and_torques_have_the_published_limits(name: str, force: float, torque: float) -> None:
    model = load_model(name)
    for side in SIDES:
        assert model.actuator(f"{side}_force_z").gainprm[0] == pytest.approx(force, rel=1e-3)
        assert model.actuator(f"{side}_torque_x").gainprm[0] == pytest.approx(torque, rel=1e-3)


def test_joint_targets_span_the_limits_of_their_joint() -> None:
    model = load_model(CATCH)
    data = mujoco.MjData(model)
    for action, bound in ((-1.0, 0), (0.0, None), (1.0, 1)):
        data.ctrl[:] = action
        for side in SIDES:
            knuckle = model.joint(f"{side}_robot0:FFJ2")
            low, high = knuckle.range
            data.qpos[knuckle.qposadr[0]] = (low + high) / 2 if bound is None else (low, high)[bound]
        mujoco.mj_forward(model, data)
        for side in SIDES:
            assert data.actuator(f"{side}_robot0:A_FFJ2").force[0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("hand", [0, 1])
def test_hand_is_observed_as_documented(name: str, hand: int) -> None:
    probe, side = Probe(name, 3), SIDES[hand]
    data, seen, first = probe.data, probe.features["hands"][0, hand], 31 * hand
    low, high = joint_limits()
    np.testing.assert_allclose(seen[:24], 2 * (data.qpos[first + 7 : first + 31] - low) / (high - low) - 1, atol=1e-12)
    np.testing.assert_allclose(seen[24:48], 0.2 * data.qvel[30 * hand + 6 : 30 * hand + 30])
    np.testing.assert_allclose(seen[48:72], np.clip(10 * data.qfrc_actuator[30 * hand + 6 : 30 * hand + 30], -5, 5))
    for place, finger in enumerate(FINGERS):
        body = data.body(f"{side}_robot0:{finger}distal")
        np.testing.assert_allclose(seen[72 + 13 * place :][:7], [*body.xpos, *body.xquat], atol=1e-12)
        np.testing.assert_allclose(seen[72 + 13 * place :][7:13], np.clip(probe.velocity(body.name), -5, 5), atol=1e-9)
    assert np.abs(seen[137:167]).max() > 0
    base = data.body(f"{side}_base")
    palm = data.body(f"{side}_robot0:palm")
    of_palm = palm.xpos + palm.xmat.reshape(3, 3) @ [0, -0.02, 0.08]
    np.testing.assert_allclose(seen[167:170], base.xpos if name == CATCH else of_palm, atol=1e-12)
    roll, pitch, yaw = seen[170:173]
    turned = np.zeros(4)
    mujoco.mju_euler2Quat(turned, np.array([roll, pitch, yaw]), "XYZ")
    assert abs(turned @ data.qpos[first + 3 : first + 7]) == pytest.approx(1.0)
    order = [*range(26 * hand + 20, 26 * hand + 26), *range(26 * hand, 26 * hand + 20)]
    np.testing.assert_array_equal(seen[173:], np.clip(data.ctrl[order], -1, 1))


@pytest.mark.parametrize("name", NAMES)
def test_agents_observe_their_hand_and_the_object(name: str) -> None:
    task = make_task(name, 2, n_threads=1, agent_index=False)
    task.reset(0)
    step = task.step(np.random.default_rng(0).uniform(-3, 3, (2, 2, 26)))
    for agent in range(2):
        own = step.state[:, 199 * agent : 199 * agent + 199]
        np.testing.assert_array_equal(step.observations[:, agent], np.hstack([own, step.state[:, 398:]]))
        assert np.abs(own[:, 173:]).max() == 1.0
    assert np.abs(step.state).max() <= 5.0


def test_egg_and_goal_are_observed_as_documented() -> None:
    probe = Probe(CATCH, 5)
    seen, egg, goal = probe.features["object"][0], probe.data.body("egg"), probe.data.body("goal")
    np.testing.assert_allclose(seen[:7], [*egg.xpos, *egg.xquat])
    np.testing.assert_allclose(seen[7:13], probe.velocity("egg") * [1, 1, 1, 0.2, 0.2, 0.2])
    np.testing.assert_allclose(seen[13:20], [*goal.xpos, *goal.xquat])
    back, expected = np.zeros(4), np.zeros(4)
    mujoco.mju_negQuat(back, goal.xquat)
    mujoco.mju_mulQuat(expected, egg.xquat, back)
    np.testing.assert_allclose(seen[20:], expected, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_catch_reward_equals_its_equation(seed: int) -> None:
    probe = Probe(CATCH, seed)
    egg, goal = probe.data.body("egg"), probe.data.body("goal")
    distance = math.dist(egg.xpos, goal.xpos)
    turn = egg.xmat.reshape(3, 3) @ goal.xmat.reshape(3, 3).T
    angle = math.acos(min(1.0, max(-1.0, (np.trace(turn) - 1) / 2)))
    assert probe.reward() == pytest.approx(math.exp(-0.2 * (20 * distance + angle)), rel=1e-6)


def door_reward(probe: Probe, name: str, near_metres: float) -> float:
    """The equations of the doors' rewards, one fingertip after the other."""
    handles = {side: probe.data.site(f"{side}_leaf_handle").xpos for side in SIDES}
    far = dict.fromkeys(SIDES, 0.0)
    for side in SIDES:
        for finger in FINGERS:
            tip = probe.data.body(f"{side}_robot0:{finger}distal")
            far[side] += math.dist(tip.xpos + tip.xmat.reshape(3, 3)[:, 2] * 0.02, handles[side])
    across = 0.0
    if max(far.values()) < near_metres:
        dy = abs(handles["right"][1] - handles["left"][1])
        across = 1 - 2 * dy if name == CLOSE else 2 * dy
    return (6 if name == CLOSE else 2) - far["right"] - far["left"] + across


@pytest.mark.parametrize("name", DOORS)
@pytest.mark.parametrize("near_metres", [0.5, 100.0])
def test_door_reward_equals_its_equation(name: str, near_metres: float, monkeypatch: pytest.MonkeyPatch) -> None:
    # Random states are seldom near enough for the angle of the door to count.
    monkeypatch.setattr(doors, "NEAR_METRES", near_metres)
    for seed in range(5):
        probe = Probe(name, seed)
        assert probe.reward() == pytest.approx(door_reward(probe, name, near_metres), rel=1e-9)


@pytest.mark.parametrize(("name", "side", "front"), [(INWARD, 1, 1), (OUTWARD, 1, -1), (CLOSE, 1, -1)])
def test_leaves_open_towards_the_hands_if_inward(name: str, side: int, front: int) -> None:
    model = load_model(name)
    data = mujoco.MjData(model)
    places = []
    for angle in (0.0, 1.5):
        data.qpos[-2:] = angle
        mujoco.mj_kinematics(model, data)
        places.append([data.site(f"{leaf}_leaf_handle").xpos.copy() for leaf in SIDES])
    closed, opened = places
    for leaf, sign in enumerate((side, -side)):
        assert closed[leaf][0] > 0.02  # The hands are in front of the handles.
        assert sign * closed[leaf][1] > 0
        assert sign * opened[leaf][1] > 0.3
        assert front * opened[leaf][0] > 0.3


def test_left_hand_is_the_mirror_image_of_the_right_one() -> None:
    turn = np.pi / 2
    spec = two_hands(
        Pose((0.5, 0.2, 0.6), (np.pi, turn, turn)),
        Pose((0.5, -0.2, 0.6), (np.pi, -turn, turn)),
        Strength(500.0, 8.0),
        (0.0,) * 6,
    )
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(25):
        data.ctrl[:26] = rng.uniform(-1, 1, 26)
        data.ctrl[26:] = data.ctrl[:26]
        data.ctrl[26 + 20 : 26 + 23] *= MIRROR
        data.ctrl[26 + 23 :] *= -MIRROR  # torques are axial vectors
        mujoco.mj_step(model, data, nstep=4)
    np.testing.assert_allclose(data.qpos[7:31], data.qpos[38:62], atol=1e-6)
    assert np.abs(data.qpos[7:31]).max() > 0.1
    for finger in FINGERS:
        right, left = (data.body(f"{side}_robot0:{finger}distal").xpos for side in SIDES)
        np.testing.assert_allclose(right * MIRROR, left, atol=1e-6)


def test_hands_touch_each_other_and_not_themselves() -> None:
    model = load_model(CATCH)
    data = mujoco.MjData(model)
    # The left palm is moved into the right one.
    mujoco.mj_forward(model, data)
    data.qpos[31:34] = data.body("right_robot0:palm").xpos - data.body("left_robot0:palm").xpos
    mujoco.mj_forward(model, data)
    sides = {
        tuple(sorted(model.geom(geom).name.split("_")[0] for geom in contact.geom))
        for contact in data.contact[: data.ncon]
    }
    assert ("left", "right") in sides
    data.qpos[31] = 5.0
    mujoco.mj_forward(model, data)
    sides = {
        tuple(sorted(model.geom(geom).name.split("_")[0] for geom in contact.geom))
        for contact in data.contact[: data.ncon]
    }
    assert ("left", "right") not in sides


@pytest.mark.parametrize("name", DOORS)
def test_door_reward_is_the_same_for_mirrored_hands(name: str) -> None:
    probe = Probe(name, 1)
    expected, hands, thing = probe.reward(), probe.features["hands"], probe.features["object"]
    hands[:] = hands[:, ::-1].copy()
    tips = hands[:, :, 72:137].reshape(1, 2, 5, 13)
    tips[..., :3] *= MIRROR
    tips[..., 3:7] *= [1.0, -1.0, 1.0, -1.0]
    thing[:, 13:19] = (thing[:, 13:19].reshape(1, 2, 3)[:, ::-1] * MIRROR).reshape(1, 6)
    assert probe.reward() == pytest.approx(expected, rel=1e-9)


def test_catch_ends_when_the_egg_falls() -> None:
    task = make_task(CATCH, 1, n_threads=1)
    task.reset(0)
    heights = []
    for _ in range(75):
        step = task.step(np.zeros((1, 2, 26)))
        heights.append(step.final_state[0, 398 + 2])
        if step.terminated[0]:
            break
    assert heights[-1] <= 0.3 < heights[-2]


@pytest.mark.parametrize("hand", [0, 1])
def test_catch_ends_when_a_base_leaves_its_place(hand: int) -> None:
    probe = Probe(CATCH, 0)
    first = np.array([pose.position for pose in catch.HANDS])
    probe.features["object"][0, 2] = 1.0
    probe.features["hands"][0, :, 167:170] = first
    assert not probe.terminated()
    probe.features["hands"][0, hand, 168] += 0.0999
    assert not probe.terminated()
    probe.features["hands"][0, hand, 168] += 0.0002
    assert probe.terminated()


@pytest.mark.parametrize(("name", "limit"), [(INWARD, 1.5), (OUTWARD, 1.5), (CLOSE, 3.0)])
@pytest.mark.parametrize("hand", [0, 1])
def test_door_ends_when_a_hand_is_far_from_its_handle(name: str, limit: float, hand: int) -> None:
    probe = Probe(name, 0)
    probe.features["hands"][0, :, 72:137] = np.tile([0, 0, -0.02, 1.0] + [0.0] * 9, 5)
    probe.features["object"][0, 13:19] = 0.0
    handle = 13 + 3 * hand
    probe.features["object"][0, handle] = limit / 5 - 0.001
    assert not probe.terminated()
    probe.features["object"][0, handle] = limit / 5 + 0.001
    assert probe.terminated()


@pytest.mark.parametrize(("degrees", "success"), [((14.0, 14.0), True), ((14.0, 16.0), False), ((80.0, 80.0), False)])
def test_a_door_is_closed_if_both_leaves_are(degrees: tuple[float, float], success: bool) -> None:
    task = make_task(CLOSE, 1, n_threads=1)
    task.reset(0)
    snapshot = task.snapshot()
    snapshot["qpos"][0, -2:] = np.radians(degrees)
    snapshot["qvel"][0, -2:] = 0.0
    task.restore(snapshot)
    step = task.step(np.zeros((1, 2, 26)))
    assert step.success is not None
    assert step.success[0] == success


@pytest.mark.parametrize("name", NAMES)
def test_no_episode_starts_at_its_end(name: str) -> None:
    task = make_task(name, 16, n_threads=1)
    task.reset(0)
    for _ in range(3):
        step = task.step(np.zeros((16, 2, 26)))
        assert not step.terminated.any()


def test_catch_turns_egg_and_goal_and_moves_neither() -> None:
    qpos, qvel = catch.sample_start(np.random.default_rng(0), 500)
    assert (qpos[:, 62:65] == catch.EGG_START).all()
    for quaternions in (qpos[:, 65:69], qpos[:, 69:73]):
        np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0)
        assert np.abs(quaternions.mean(axis=0)[1:]).max() < 0.1
        assert quaternions[:, 1:3].std(axis=0).min() > 0.3
    assert not qvel.any()


def test_goal_keeps_its_place_and_orientation() -> None:
    task = make_task(CATCH, 1, n_threads=1)
    task.reset(0)
    before = task.simulator_state()[0][0, 69:]
    for _ in range(30):
        task.step(np.zeros((1, 2, 26)))
    np.testing.assert_array_equal(task.simulator_state()[0][0, 69:], before)


def test_angles_and_relative_rotations_follow_mujocos_quaternions() -> None:
    angles = np.array([0.3, -0.4, 1.2])
    one, other = np.zeros(4), np.zeros(4)
    mujoco.mju_euler2Quat(one, angles, "XYZ")
    mujoco.mju_euler2Quat(other, angles[::-1].copy(), "XYZ")
    written = np.zeros(3)
    write_roll_pitch_yaw(one, written)
    np.testing.assert_allclose(written, angles)
    np.testing.assert_allclose(relative_quaternion(one[None], one[None])[0], [1, 0, 0, 0], atol=1e-12)
    product = np.zeros(4)
    mujoco.mju_mulQuat(product, relative_quaternion(one[None], other[None])[0], other)
    np.testing.assert_allclose(product, one)


def test_stored_throw_brings_the_egg_to_its_goal() -> None:
    # Found by a cross-entropy search for five constant actions of 15 steps each.
    stored = np.load(STORED / "throw.npz")
    task = make_task(CATCH, 1, n_threads=1)
    task.reset(0)
    snapshot = task.snapshot()
    snapshot["qpos"][0] = stored["qpos"]
    task.restore(snapshot)
    distances, caught = [], []
    for action in np.repeat(stored["actions"], 15, axis=0):
        step = task.step(action[None])
        assert step.success is not None
        caught.append(bool(step.success[0]))
        thing = step.final_state[0, 398:]
        distances.append(np.linalg.norm(thing[:3] - thing[13:16]))
        if step.terminated[0]:
            break
    assert distances[0] > 0.5
    assert min(distances) < 0.05
    assert caught == [distance < 0.05 for distance in distances]


@pytest.mark.parametrize(("name", "stored"), [(OUTWARD, "push"), (INWARD, "pull")])
def test_stored_actions_open_both_leaves(name: str, stored: str) -> None:
    # Found in the same way, mirrored for the left hand: five pushes of 50 steps; ten actions of 25 steps that pull.
    actions = np.load(STORED / f"{stored}.npz")["actions"]
    task = make_task(name, 1, n_threads=1)
    task.reset(0)
    angles = []
    for action in np.repeat(actions, 250 // len(actions), axis=0):
        step = task.step(action[None])
        assert not step.terminated[0]
        assert step.success is not None
        angles.append(task.simulator_state()[0][0, -2:])
        opened = min(angles[-1]) >= np.radians(75)
        assert step.success[0] == opened
        if opened:
            return
    pytest.fail(f"the leaves opened to {np.degrees(angles[-1])} degrees")
