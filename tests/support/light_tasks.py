"""PettingZoo tasks whose images show their state, as a task file (see docs/tasks.md).

Two agents each press a button. A light gets brighter with each step in which both press. `Buttons-2` renders and is
deterministic, `BlindButtons-2` does not render, and `DicedButtons-2` is not deterministic given its seed.
"""

from functools import partial
from itertools import count

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from mapt.tasks import PettingZooDefinition, register_task

HORIZON_STEPS = 30
#: height and width; odd, which the codec does not support
PICTURE = (45, 63)
LEVELS = 8
ENVIRONMENT = {"MAPT_TASKS": __file__}
#: the randomness of DicedButtons: it continues from one environment to the next
_dice = count()


class Buttons(ParallelEnv):
    def __init__(self, draws: bool = True, diced: bool = False) -> None:
        self.possible_agents = ["left", "right"]
        self.agents = []
        self._draws, self._diced = draws, diced

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 1, (2,))

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.agents = list(self.possible_agents)
        self.level = int(np.random.default_rng(seed).integers(LEVELS))
        return self._seen(), {}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        both = all(actions.values())
        self.level = (self.level + both) % LEVELS
        reward = float(both) + (next(_dice) % 7 if self._diced else 0)
        no = dict.fromkeys(self.agents, False)
        return self._seen(), dict.fromkeys(self.agents, reward), no, no, {}

    def render(self) -> np.ndarray | None:
        return np.full((*PICTURE, 3), light(self.level), dtype=np.uint8) if self._draws else None

    def _seen(self) -> dict:
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
        _definition("BlindButtons-2", draws=False),
        _definition("DicedButtons-2", diced=True),
    ):
        register_task(task)
