"""How a PettingZoo parallel environment becomes a task with a name."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from mapt.tasks.errors import NoSimulator, UnusableEnvironment
from mapt.tasks.parallel_task import ParallelEnv, ParallelTask, has_masks, split, state_of
from mapt.tasks.protocol import Task, TaskSpec

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false


@dataclass(frozen=True)
class ParallelEntry:
    """A task made of any `pettingzoo.ParallelEnv`.

    Agents see what their environment shows them: `agent_obsk` changes nothing.
    """

    name: str
    #: Makes one environment; with render_mode="rgb_array" where it can draw.
    make_env: Callable[[], ParallelEnv]
    #: Steps after which an episode is cut, if it has not ended by itself.
    horizon_steps: int
    step_seconds: float
    #: What the team should achieve, in plain words for a labeller.
    instructions: str

    def spec(self, *, agent_obsk: int | None, agent_index: bool) -> TaskSpec:
        """See `TaskEntry.spec`. The first call makes an environment and looks.

        Raises:
            UnusableEnvironment: if some agents' actions are discrete and others' not, or of different numbers.
        """
        seen = self._seen
        return TaskSpec(**{**seen, "observation_dim": seen["observation_dim"] + seen["n_agents"] * agent_index})

    def make(
        self, n_envs: int, *, n_threads: int, agent_obsk: int | None, agent_index: bool, dtype: type[np.floating]
    ) -> Task:
        """See `make_task`; environments are stepped in this thread."""
        spec = self.spec(agent_obsk=agent_obsk, agent_index=agent_index)
        return ParallelTask(spec, self.make_env, n_envs=n_envs, agent_index=agent_index, dtype=dtype)

    def load_model(self) -> mujoco.MjModel:
        raise NoSimulator(self.name)

    def agent_geoms(self) -> tuple[tuple[int, ...], ...]:
        raise NoSimulator(self.name)

    @cached_property
    def _seen(self) -> dict[str, Any]:
        env = self.make_env()
        observed, _ = env.reset(seed=0)
        agents = tuple(env.possible_agents)
        width = max(np.size(split(observed[agent])[0]) for agent in agents)
        spaces = [env.action_space(agent) for agent in agents]
        discrete = [hasattr(space, "n") for space in spaces]
        sizes = tuple(int(space.n) if hasattr(space, "n") else int(np.prod(space.shape)) for space in spaces)
        if any(discrete) and (not all(discrete) or len(set(sizes)) > 1):
            raise UnusableEnvironment(
                f"{self.name}: all agents must have as many discrete actions, or continuous ones."
            )
        limit = (
            1.0 if discrete[0] else float(max(np.abs([space.low.max(), space.high.max()]).max() for space in spaces))
        )
        state_dim = state_of(env, np.zeros((len(agents), width))).size
        masks = has_masks(env)
        env.close()
        return {
            "name": self.name,
            "n_agents": len(agents),
            "observation_dim": width,
            "action_dim": max(sizes),
            "state_dim": state_dim,
            "horizon_steps": self.horizon_steps,
            "step_seconds": self.step_seconds,
            "agent_names": tuple(agent.replace("_", " ") for agent in agents),
            "nq": 0,
            "nv": 0,
            "instructions": self.instructions,
            "discrete_actions": discrete[0],
            "action_limit": limit,
            "agent_action_dims": () if discrete[0] else sizes,
            "masks_actions": masks,
        }
