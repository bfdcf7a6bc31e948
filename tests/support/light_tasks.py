"""PettingZoo tasks whose images show their state, as a task file (see docs/how-to/task.md).

Two agents each press a button. A light gets brighter with each step in which both press. `Buttons-2` renders and is
deterministic, `BlindButtons-2` does not render, and `VaryingButtons-2` is not deterministic given its seed.
"""

from functools import partial
from itertools import count

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from mapt.tasks import PettingZooDefinition, register_task

HORIZON_STEPS = 30
#: height and width; odd, which the codec does not support
IMAGE_SIZE = (45, 63)
LEVELS = 8
ENVIRONMENT = {"MAPT_TASKS": __file__}
#: counts the steps of all environments of VaryingButtons, whose rewards depend on it
_steps = count()


class Buttons(ParallelEnv):
    def __init__(self, renders: bool = True, varying_rewards: bool = False) -> None:
        self.possible_agents = ["left", "right"]
        self.agents = []
        self._renders, self._varying_rewards = renders, varying_rewards

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 1, (2,))

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.agents = list(self.possible_agents)
        self.level = int(np.random.default_rng(seed).integers(LEVELS))
        return self._observations(), {}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        pressed = all(actions.values())
        self.level = (self.level + pressed) % LEVELS
        reward = float(pressed) + (next(_steps) % 7 if self._varying_rewards else 0)
        flags = dict.fromkeys(self.agents, False)
        return self._observations(), dict.fromkeys(self.agents, reward), flags, flags, {}

    def render(self) -> np.ndarray | None:
        return np.full((*IMAGE_SIZE, 3), light(self.level), dtype=np.uint8) if self._renders else None

    def _observations(self) -> dict:
        return dict.fromkeys(self.agents, np.array([self.level / LEVELS, 1.0], dtype=np.float32))


def light(level: int) -> int:
    """Grey level of the image, 0 to 255."""
    return 20 + 28 * level


def _definition(name: str, **options: bool) -> PettingZooDefinition:
    return PettingZooDefinition(name, partial(Buttons, **options), HORIZON_STEPS, 0.1, "Hold both buttons at once.")


if __name__ == "light_tasks":
    # Only when run as a task file, not when a test imports this module.
    for task in (
        _definition("Buttons-2"),
        _definition("BlindButtons-2", renders=False),
        _definition("VaryingButtons-2", varying_rewards=True),
    ):
        register_task(task)
