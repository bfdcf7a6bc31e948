"""A small PettingZoo environment with discrete actions and action masks."""

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv


class Levers(ParallelEnv):
    """Two agents pull one of three levers, not the same one twice in a row. A pull of lever 2 has a reward of 1.

    The episode ends when both pull lever 0.
    """

    def __init__(self) -> None:
        self.possible_agents = ["left", "right"]
        self.agents = []

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Dict({"observation": spaces.Box(-1, 3, (2,)), "action_mask": spaces.MultiBinary(3)})

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(3)

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.agents = list(self.possible_agents)
        self.rng = np.random.default_rng(seed)
        self.pulled = {"left": -1, "right": -1}
        return self.observations(), {}

    def observations(self) -> dict:
        return {
            agent: {"observation": np.array([pulled, self.rng.uniform()]), "action_mask": np.arange(3) != pulled}
            for agent, pulled in self.pulled.items()
        }

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        self.pulled = dict(actions)
        terminated = all(action == 0 for action in actions.values())
        flags = dict.fromkeys(self.agents, False)
        rewards = {agent: float(action == 2) for agent, action in actions.items()}
        observations = self.observations()
        if terminated:
            self.agents = []
        return observations, rewards, dict.fromkeys(actions, terminated), flags, {}


class RenderableLevers(Levers):
    """Levers with images whose grey level shows the last lever of the left agent."""

    def render(self) -> np.ndarray:
        return np.full((2, 3, 3), 10 + self.pulled["left"], dtype=np.uint8)
