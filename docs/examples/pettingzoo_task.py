"""A PettingZoo environment as a task file: two agents on a line, who should meet.

MAPT_TASKS=docs/examples/pettingzoo_task.py mapt train --task Meeting-2 --reward true --steps 20000 --output runs
"""

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from mapt.tasks import PettingZooDefinition, register_task

AGENTS = ("red", "blue")
COLOURS = {"red": "#d62828", "blue": "#1d70b8"}
HORIZON_STEPS = 50
WIDTH, HEIGHT, RADIUS = 320, 64, 6


class Meeting(ParallelEnv):
    """Each agent observes both positions, in -1 to 1, its own first; an action moves it by up to 0.1."""

    def __init__(self) -> None:
        self.possible_agents = list(AGENTS)
        self.agents = []
        self._positions = np.zeros(2)

    def observation_space(self, agent: str) -> Box:
        return Box(-1, 1, (2,))

    def action_space(self, agent: str) -> Box:
        return Box(-1, 1, (1,))

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self.agents = list(AGENTS)
        self._positions = np.random.default_rng(seed).uniform(-1, 1, 2)
        return self._observations(), {}

    def step(self, actions: dict[str, np.ndarray]) -> tuple[dict, dict, dict, dict, dict]:
        moves = np.concatenate([actions[name] for name in AGENTS])
        self._positions = np.clip(self._positions + 0.1 * np.clip(moves, -1, 1), -1, 1)
        distance = float(abs(self._positions[0] - self._positions[1]))
        ended = dict.fromkeys(AGENTS, False)
        return self._observations(), dict.fromkeys(AGENTS, -distance), ended, ended, {}

    def render(self) -> np.ndarray:
        """An image of the line from the side, uint8 (HEIGHT, WIDTH, 3)."""
        image = np.full((HEIGHT, WIDTH, 3), 255, dtype=np.uint8)
        image[HEIGHT // 2 + RADIUS] = 0
        for position, colour in zip(self._positions, COLOURS.values(), strict=True):
            x = RADIUS + round((position + 1) / 2 * (WIDTH - 2 * RADIUS))
            image[HEIGHT // 2 - RADIUS : HEIGHT // 2 + RADIUS, x - RADIUS : x + RADIUS] = list(
                bytes.fromhex(colour[1:])
            )
        return image

    def _observations(self) -> dict[str, np.ndarray]:
        own, other = self._positions.astype(np.float32)
        return {"red": np.array([own, other]), "blue": np.array([other, own])}


register_task(
    PettingZooDefinition(
        name="Meeting-2",
        make_env=Meeting,
        horizon_steps=HORIZON_STEPS,
        step_seconds=0.1,
        instructions="Bring the two agents together.",
        agent_colours=tuple(COLOURS.values()),
    )
)
