"""MaMuJoCo of gymnasium-robotics as a reference, which can be set to the states of our tasks."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from gymnasium.wrappers import TimeLimit
from gymnasium_robotics import mamujoco_v1
from gymnasium_robotics.envs.multiagent_mujoco import coupled_half_cheetah, obsk

#: Partitions without a name in MaMuJoCo: one agent per joint.
ONE_AGENT_PER_JOINT = {("Ant", "8x1"), ("Walker2d", "6x1"), ("Humanoid", "17x1"), ("HumanoidStandup", "17x1")}
COUPLED = "CoupledHalfCheetah"
TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class ReferenceStep:
    state: np.ndarray
    reward: float
    terminated: bool
    truncated: bool


class Reference:
    """One simulation, observed with several values of `agent_obsk`."""

    def __init__(self, task_name: str, depths: tuple[int | None, ...]) -> None:
        scenario, conf = task_name.split("-")
        first, *others = depths
        self.views = {first: make_view(scenario, conf, first, None)}
        self.env = self.views[first]
        for depth in others:
            self.views[depth] = make_view(scenario, conf, depth, self.env.single_agent_env)

    def start_from(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Reset the simulation, including the solver, to these positions and velocities."""
        self.env.reset(seed=0)
        single = self.env.single_agent_env.unwrapped
        mujoco.mj_resetData(single.model, single.data)
        single.set_state(qpos, qvel)

    def observations(self, depth: int | None) -> list[np.ndarray]:
        return list(self.views[depth]._get_obs().values())

    def state(self) -> np.ndarray:
        return self.env.state()

    def step(self, actions: np.ndarray, action_dims: tuple[int, ...]) -> ReferenceStep:
        """One step with actions (N, A), without their padding."""
        used = [action[:dim] for action, dim in zip(actions, action_dims, strict=True)]
        _, rewards, terminations, truncations, _ = self.env.step(dict(zip(self.env.possible_agents, used, strict=True)))
        first = self.env.possible_agents[0]
        return ReferenceStep(self.state(), float(rewards[first]), bool(terminations[first]), bool(truncations[first]))

    def set_elapsed_steps(self, n_steps: int) -> None:
        """Set the number of elapsed steps of the episode."""
        limited = self.env.single_agent_env
        while not hasattr(limited, "_elapsed_steps"):
            limited = limited.env
        limited._elapsed_steps = n_steps

    def sample_start(self, seed: int) -> np.ndarray:
        self.env.reset(seed=seed)
        data = self.env.single_agent_env.unwrapped.data
        return np.concatenate([data.qpos, data.qvel])

    @property
    def model(self) -> mujoco.MjModel:
        return self.env.single_agent_env.unwrapped.model


def make_view(scenario: str, conf: str, depth: int | None, env: Any) -> Any:
    factorization = None
    if scenario == COUPLED:
        env = env or coupled_cheetahs()
        factorization = coupled_factorization(conf, env.unwrapped.model)
    elif (scenario, conf) in ONE_AGENT_PER_JOINT:
        parts, edges, shared = obsk.get_parts_and_edges(scenario, None)
        factorization = {"partition": [(node,) for node in parts[0]], "edges": edges, "globals": shared}
    view = mamujoco_v1.parallel_env(scenario, conf, depth, factorization, gym_env=env)
    for groups in getattr(view, "k_dicts", []):
        # MaMuJoCo sorts a set by labels only. Two joints of Pusher have equal labels, so their order varies.
        for nodes in groups.values():
            nodes.sort(key=lambda node: (node.label, node.qpos_ids))
    return view


def tendon_moments(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """The entries of ten_J that gymnasium-robotics reads: x and z of each cheetah. MuJoCo 4 stores ten_J as sparse."""
    dense = np.zeros((1, model.nv))
    dense[0, model.ten_J_colind] = data.ten_J
    return dense[0, [0, 1, 9, 10]]


class TiedCheetahs(coupled_half_cheetah.CoupledHalfCheetahEnv):
    """gymnasium-robotics' environment with a fix of the one line that fails with MuJoCo 4."""

    def _get_obs(self) -> np.ndarray:
        qpos = self.data.qpos
        tendon = (tendon_moments(self.model, self.data), self.data.ten_length, self.data.ten_velocity)
        return np.concatenate([qpos[1:9], qpos[10:18], self.data.qvel, *tendon])


def coupled_cheetahs() -> TimeLimit:
    return TimeLimit(TiedCheetahs(), max_episode_steps=1000)


def coupled_factorization(conf: str, model: mujoco.MjModel) -> dict[str, Any]:
    parts, edges, shared = obsk.get_parts_and_edges(COUPLED, conf)
    for part in parts:
        part[0].extra_obs["ten_J"] = lambda data: tendon_moments(model, data)
    return {"partition": parts, "edges": edges, "globals": shared}


def without_padding(observation: np.ndarray, reference: np.ndarray, n_shared: int) -> np.ndarray:
    """Our observation without the padding before its shared part."""
    n_missing = observation.size - reference.size
    end = observation.size - n_shared
    np.testing.assert_array_equal(observation[end - n_missing : end], 0.0)
    return np.delete(observation, np.s_[end - n_missing : end])


def assert_close(ours: np.ndarray, theirs: np.ndarray) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=TOLERANCE, atol=TOLERANCE)


def assert_same_observations(ours: np.ndarray, theirs: list[np.ndarray], n_shared: int) -> None:
    for observation, reference in zip(ours, theirs, strict=True):
        assert_close(without_padding(observation, reference, n_shared), reference)
