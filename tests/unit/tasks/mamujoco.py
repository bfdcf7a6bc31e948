"""gymnasium-robotics' MaMuJoCo as a reference: one environment of theirs that follows one of ours."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from gymnasium.wrappers import TimeLimit
from gymnasium_robotics import mamujoco_v1
from gymnasium_robotics.envs.multiagent_mujoco import coupled_half_cheetah, obsk

#: Partitions that MaMuJoCo has no name for: one agent per joint.
OF_ONE_JOINT = {("Ant", "8x1"), ("Walker2d", "6x1"), ("Humanoid", "17x1"), ("HumanoidStandup", "17x1")}
COUPLED = "CoupledHalfCheetah"
TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class ReferenceStep:
    state: np.ndarray
    reward: float
    terminated: bool
    truncated: bool


class Reference:
    """One simulation, seen with each of several `agent_obsk`."""

    def __init__(self, task_name: str, depths: tuple[int | None, ...]) -> None:
        scenario, conf = task_name.split("-")
        first, *others = depths
        self.views = {first: make_view(scenario, conf, first, None)}
        self.env = self.views[first]
        for depth in others:
            self.views[depth] = make_view(scenario, conf, depth, self.env.single_agent_env)

    def start_from(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Reset them, but to our start: the solver, too, begins as after a reset."""
        self.env.reset(seed=0)
        single = self.env.single_agent_env.unwrapped
        mujoco.mj_resetData(single.model, single.data)
        single.set_state(qpos, qvel)

    def observations(self, depth: int | None) -> list[np.ndarray]:
        return list(self.views[depth]._get_obs().values())

    def state(self) -> np.ndarray:
        return self.env.state()

    def step(self, actions: np.ndarray, action_dims: tuple[int, ...]) -> ReferenceStep:
        """One step from actions (N, A), of which each agent uses as many as it has joints."""
        used = [action[:dim] for action, dim in zip(actions, action_dims, strict=True)]
        _, rewards, terminations, truncations, _ = self.env.step(dict(zip(self.env.possible_agents, used, strict=True)))
        first = self.env.possible_agents[0]
        return ReferenceStep(self.state(), float(rewards[first]), bool(terminations[first]), bool(truncations[first]))

    def age(self, n_steps: int) -> None:
        """Let the episode be this many steps old."""
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
    elif (scenario, conf) in OF_ONE_JOINT:
        parts, edges, shared = obsk.get_parts_and_edges(scenario, None)
        factorization = {"partition": [(node,) for node in parts[0]], "edges": edges, "globals": shared}
    view = mamujoco_v1.parallel_env(scenario, conf, depth, factorization, gym_env=env)
    for groups in getattr(view, "k_dicts", []):
        # They sort a set by labels alone; two joints of Pusher share one, and would come as chance has it.
        for nodes in groups.values():
            nodes.sort(key=lambda node: (node.label, node.qpos_ids))
    return view


def tendon_moments(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """What gymnasium-robotics reads of the dense ten_J, which MuJoCo 4 keeps sparse: x and z of each cheetah."""
    dense = np.zeros((1, model.nv))
    dense[0, model.ten_J_colind] = data.ten_J
    return dense[0, [0, 1, 9, 10]]


class TiedCheetahs(coupled_half_cheetah.CoupledHalfCheetahEnv):
    """Their environment with the one line mended that MuJoCo 4 breaks."""

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
    """Our observation with the zeros of missing neighbours, which stand before the shared part, taken out."""
    n_missing = observation.size - reference.size
    end = observation.size - n_shared
    np.testing.assert_array_equal(observation[end - n_missing : end], 0.0)
    return np.delete(observation, np.s_[end - n_missing : end])


def assert_close(ours: np.ndarray, theirs: np.ndarray) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=TOLERANCE, atol=TOLERANCE)


def assert_same_observations(ours: np.ndarray, theirs: list[np.ndarray], n_shared: int) -> None:
    for observation, reference in zip(ours, theirs, strict=True):
        assert_close(without_padding(observation, reference, n_shared), reference)
