"""A match on the engine of Google Research Football, in a process of its own.

This module uses the engine's compiled module, `gfootball_engine`, not its Gym environment, which repeats every array of
a step for each agent. Its rules of when episodes end are those of that environment, with which a test compares it.
"""

import signal
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapt.processes import ParentConnection
from mapt.tasks.football.match import NOBODY, NORMAL
from mapt.tasks.football.scenarios import LIMIT_STEPS, Scenario, Start

#: the engine's module, and how to get it
ENGINE, INSTALL = "gfootball_engine", "`make football` in a clone of Accord installs it"
#: the engine's names of the actions, in the order of their numbers
ACTIONS = (
    "idle",
    *("left", "top_left", "top", "top_right", "right", "bottom_right", "bottom", "bottom_left"),
    *("long_pass", "high_pass", "short_pass", "shot"),
    *("sprint", "release_direction", "release_sprint", "sliding", "dribble", "release_dribble"),
)
_STICKY = (*ACTIONS[1:9], "sprint", "dribble")

State = NDArray[np.float64]
#: A method of `EngineMatch` and its arguments.
Request = tuple[Any, ...]


def is_installed() -> bool:
    """Whether the engine is installed. Does not load it."""
    return find_spec(ENGINE) is not None


class EngineMatch:
    """One match. Call `start` or `load` first.

    Args:
        scenario: who plays, and where.

    Raises:
        ImportError: if the engine is not installed.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario, self._engine = scenario, import_module(ENGINE)
        self._actions = [getattr(self._engine.e_BackendAction, name) for name in ACTIONS]
        self._sticky = [getattr(self._engine.e_BackendAction, name) for name in _STICKY]
        self._game = self._engine.GameEnv()
        self._game.game_config.physics_steps_per_frame = 10
        self._game.start_game()
        self._last_owner_team, self._last_mode = NOBODY, NOBODY
        self._facts: Any = None
        self.start(0)

    def start(self, seed: int) -> State:
        """Start a match; equal seeds give equal matches."""
        config = self._engine.ScenarioConfig.make()
        config.game_duration = LIMIT_STEPS
        config.deterministic, config.offsides, config.real_time = False, False, False
        config.end_episode_on_score = True
        config.end_episode_on_out_of_play = True
        config.end_episode_on_possession_change = True
        config.left_agents, config.right_agents = self._scenario.n_agents, 0
        config.ball_position[0], config.ball_position[1] = self._scenario.ball
        for start in self._scenario.team:
            config.left_team.append(self._entry(start))
        for start in self._scenario.opponents:
            config.right_team.append(self._entry(start))
        config.game_engine_random_seed = seed
        config.reverse_team_processing = bool(seed % 2)
        self._game.state = self._engine.GameState.game_running
        self._game.reset(config, False)
        self._last_owner_team, self._last_mode = NOBODY, NOBODY
        while not self._read():
            self._game.step()
        return self._state()

    def step(self, actions: tuple[int, ...], next_seed: int) -> tuple[State, bool, State | None]:
        """Carry out one action per agent.

        Returns:
            the state after it, whether the match is over, and if so, the first state of a match with the next seed.
        """
        for agent, action in enumerate(actions):
            self._game.perform_action(self._actions[action], True, agent)
        self._game.step()
        while not self._read():
            self._game.step()
        state, over = self._state(), self._is_over()
        return state, over, self.start(next_seed) if over else None

    def save(self) -> bytes:
        """Everything that determines how the match continues."""
        own = f"{self._last_owner_team} {self._last_mode}"
        return self._game.get_state(own.encode())

    def load(self, saved: bytes) -> State:
        """Continue from a result of `save` of the same scenario."""
        own = self._game.set_state(saved)
        self._last_owner_team, self._last_mode = map(int, own.split())
        self._read()
        return self._state()

    def _entry(self, start: Start) -> Any:
        role = getattr(self._engine.e_PlayerRole, f"e_PlayerRole_{start.role}")
        return self._engine.FormationEntry(start.x, start.y, role, False, True)

    def _read(self) -> bool:
        """Read the engine's facts. Returns whether the match is in play, which it is not during its cut scenes."""
        self._facts = self._game.get_info()
        return self._facts.is_in_play

    def _state(self) -> State:
        """See `Match`."""
        facts, game = self._facts, self._game
        ball, velocity = facts.ball_position, facts.ball_direction
        numbers = [ball[0], ball[1], ball[2], velocity[0], velocity[1], velocity[2]]
        numbers += [facts.ball_owned_team, facts.ball_owned_player, facts.left_goals, facts.right_goals]
        # The engine counts from -1.
        numbers += [facts.step + 1, int(facts.game_mode)]
        for agent in range(self._scenario.n_agents):
            numbers.append(facts.left_controllers[agent].controlled_player)
            numbers += [game.sticky_action_state(action, True, agent) for action in self._sticky]
        for team in (facts.left_team, facts.right_team):
            for player in team:
                place, velocity = player.position, player.direction
                numbers += [place[0], place[1], velocity[0], velocity[1]]
                numbers += [player.tired_factor, player.has_card, player.is_active, int(player.role)]
        return np.array(numbers, dtype=np.float64)

    def _is_over(self) -> bool:
        """Whether the match ends with this step. Called once per step."""
        facts = self._facts
        mode, owner_team = int(facts.game_mode), facts.ball_owned_team
        out_of_play = mode != NORMAL and self._last_mode == NORMAL
        changed = NOBODY not in (owner_team, self._last_owner_team) and owner_team != self._last_owner_team
        self._last_mode = mode
        if owner_team != NOBODY:
            self._last_owner_team = owner_team
        over = bool(facts.left_goals or facts.right_goals or out_of_play or changed or facts.step + 1 >= LIMIT_STEPS)
        if over:
            self._game.state = self._engine.GameState.game_done
        return over


class EngineJob:
    """The job function of a process with one match. Each job is a `Request`."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._match: EngineMatch | None = None

    def __call__(self, request: Request, _parent: ParentConnection) -> Any:
        if self._match is None:
            # Ctrl-C reaches all processes of a terminal, but the parent still needs the match, to store it.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            self._match = EngineMatch(self._scenario)
        method, *arguments = request
        return getattr(self._match, method)(*arguments)
