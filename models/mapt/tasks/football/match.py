"""The state of a match as one vector of numbers: the engine's raw observations.

Observations, masks, rewards and drawings are computed from it, so segments keep it and none of them needs the engine.

Coordinates are the engine's: x from -1 to 1, the opponents' goal at 1; y from -0.42 to 0.42, to the right of a player
who attacks; z in metres. One unit is 54.4 m along x and 83.6 m along y. Velocities are coordinates per step.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.football.scenarios import Scenario

#: ball x, y, z; its velocity; team and player that own it; goals of both teams; elapsed steps; mode
_MATCH_NUMBERS = 12
#: the player that the agent controls, then which of its ten sticky actions are active
_AGENT_NUMBERS = 11
#: x, y, velocity along x and y, tiredness, yellow card, present, role
_PLAYER_NUMBERS = 8

#: values of `Match.owner_team`
NOBODY, OURS, THEIRS = -1, 0, 1
#: columns of a state: the ball's position and velocity, and whole numbers from the owner's team to the mode
_BALL, _BALL_VELOCITY, _WHOLE = slice(0, 3), slice(3, 6), slice(6, _MATCH_NUMBERS)
_GOALS, _MODE = slice(8, 10), 11
#: modes of the match: normal, kick-off, goal kick, free kick, corner, throw-in, penalty
N_MODES = 7
NORMAL = 0
#: places of two sticky actions after the eight directions
SPRINT, DRIBBLE = 8, 9
N_STICKY = 10
#: half the width of the goals, and x of a ball that lies in one
GOAL_Y, IN_GOAL_X = 0.044, 1.02


def state_size(scenario: Scenario) -> int:
    """Numbers in a state."""
    players = len(scenario.team) + len(scenario.opponents)
    return _MATCH_NUMBERS + _AGENT_NUMBERS * scenario.n_agents + _PLAYER_NUMBERS * players


@dataclass(frozen=True, slots=True)
class Players:
    """The players of a team in E matches."""

    #: (E, P, 2)
    position: NDArray[np.float64]
    #: (E, P, 2): coordinates per step
    velocity: NDArray[np.float64]
    #: (E, P): from 0, fresh, to 1
    tired: NDArray[np.float64]
    #: (E, P) bool: has a yellow card
    carded: NDArray[np.bool_]
    #: (E, P) bool: not sent off
    present: NDArray[np.bool_]
    #: (E, P) int: see `ROLES`
    role: NDArray[np.int64]

    @classmethod
    def of(cls, numbers: NDArray[np.float64]) -> "Players":
        """Read (E, P, 8)."""
        return cls(
            position=numbers[..., 0:2],
            velocity=numbers[..., 2:4],
            tired=numbers[..., 4],
            carded=numbers[..., 5] > 0,
            present=numbers[..., 6] > 0,
            role=numbers[..., 7].astype(np.int64),
        )


@dataclass(frozen=True, slots=True)
class Match:
    """E matches of N agents."""

    #: (E, 3)
    ball: NDArray[np.float64]
    #: (E, 3): coordinates per step
    ball_velocity: NDArray[np.float64]
    #: (E,) int: NOBODY, OURS or THEIRS
    owner_team: NDArray[np.int64]
    #: (E,) int: the owner's number in its team, or NOBODY
    owner: NDArray[np.int64]
    #: (E, 2): of our team and of the opponents
    goals: NDArray[np.float64]
    #: (E,) int
    elapsed_steps: NDArray[np.int64]
    #: (E,) int: see `N_MODES`
    mode: NDArray[np.int64]
    #: (E, N) int: number in our team of the player that each agent controls
    controlled: NDArray[np.int64]
    #: (E, N, 10) bool: eight directions, sprint, dribble
    sticky: NDArray[np.bool_]
    team: Players
    opponents: Players

    @classmethod
    def of(cls, states: NDArray[np.float64], scenario: Scenario) -> "Match":
        """Read states (E, nq)."""
        rest, n, ours = states[:, _MATCH_NUMBERS:], scenario.n_agents, len(scenario.team)
        agents = rest[:, : n * _AGENT_NUMBERS].reshape(len(states), n, _AGENT_NUMBERS)
        players = rest[:, n * _AGENT_NUMBERS :].reshape(len(states), -1, _PLAYER_NUMBERS)
        whole = states[:, _WHOLE].astype(np.int64)
        return cls(
            ball=states[:, _BALL],
            ball_velocity=states[:, _BALL_VELOCITY],
            owner_team=whole[:, 0],
            owner=whole[:, 1],
            goals=states[:, _GOALS],
            elapsed_steps=whole[:, 4],
            mode=whole[:, 5],
            controlled=agents[..., 0].astype(np.int64),
            sticky=agents[..., 1:] > 0,
            team=Players.of(players[:, :ours]),
            opponents=Players.of(players[:, ours:]),
        )

    def of_agents(self, per_player: NDArray) -> NDArray:
        """Values (E, N, ...) of the players that agents control, from those of all our players (E, P, ...)."""
        return per_player[np.arange(len(per_player))[:, None], self.controlled]


def last_states(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the last states (E, nq) of matches look like, from those before and after the step that ended them.

    After a goal, and when the ball is out of play, the engine has already placed ball and players for what comes next.
    Then the ball is where it flew, after a goal at rest in the goal, and the players are where they were.
    """
    scored = after[:, _GOALS].any(axis=1)
    flew = scored | (after[:, _MODE] != NORMAL)
    last = np.where(flew[:, None], before, after)
    last[:, _WHOLE] = after[:, _WHOLE]
    last[flew, _BALL] += before[flew, _BALL_VELOCITY]
    last[scored, 0] = IN_GOAL_X * np.where(after[scored, _GOALS.start] > 0, 1.0, -1.0)
    last[scored, 1] = np.clip(last[scored, 1], -GOAL_Y, GOAL_Y)
    last[scored, 2] = 0.0
    last[scored, _BALL_VELOCITY] = 0.0
    return last
