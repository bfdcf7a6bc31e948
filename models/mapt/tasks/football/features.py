"""What agents observe of a match, what they may do, and the state that critics see.

The groups and sizes are those of the encoder that the paper's benchmark uses, 63 + 7 (L + R) numbers for L of our
players and R opponents: 105 for 3-vs-1, 217 for the counterattacks and 98 for pass-and-shoot. The layout is our own:

| numbers | what |
|---|---|
| 19 | the available actions |
| 19 | own player: position 2, velocity 2, speed, role 10, tiredness, distance to the ball, sprints, dribbles |
| 18 | ball: position 3, velocity 3, speed, zone 6, owned by nobody, us, them 3, vector from the own player 2 |
| 7 (L - 1) | each of our other players: vector from the own one 2, velocity 2, speed, distance, tiredness |
| 7 | the nearest of them |
| 7 R | each opponent: the same |
| 7 | the nearest of them |

The ball's zones are those of `ball_zone`, with each goal, and what is above it, as a part of its penalty area, and
outside of the pitch.
Velocities and speeds of players are 100 times, those of the ball 20 times coordinates per step. Players who were sent
off are zeros.
"""

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.football.match import (
    DRIBBLE,
    GOAL_Y,
    N_MODES,
    N_STICKY,
    NOBODY,
    OURS,
    SPRINT,
    Match,
    Players,
)
from mapt.tasks.football.scenarios import LIMIT_STEPS, ROLES, Scenario

#: the first numbers of actions of a kind; see `engine.ACTIONS`
IDLE, KICKS = 0, slice(9, 13)
START_SPRINT, END_DIRECTION, END_SPRINT, SLIDE, START_DRIBBLE, END_DRIBBLE = range(13, 19)
N_ACTIONS = 19
#: distance within which an agent can kick a ball that nobody owns
KICK_DISTANCE = 0.03
#: x beyond which the last third and the penalty area start, and half the width of that area
THIRD_X, PENALTY_X, PENALTY_Y = 0.2, 0.64, 0.27
_END_X, _END_Y = 1.0, 0.42
_OUTSIDE = 3
_PLAYER_SPEED, _BALL_SPEED = 100.0, 20.0
_PLAYER_NUMBERS, _STATE_PLAYER_NUMBERS = 7, 5

Floats = NDArray[np.float64]


def observation_size(scenario: Scenario) -> int:
    """C, without the agent's index."""
    return 63 + _PLAYER_NUMBERS * (len(scenario.team) + len(scenario.opponents))


def global_state_size(scenario: Scenario) -> int:
    """S; see `global_state`."""
    players = len(scenario.team) + len(scenario.opponents)
    return 10 + N_MODES + _STATE_PLAYER_NUMBERS * players + scenario.n_agents * len(scenario.team)


def ball_zone(ball: Floats) -> NDArray[np.int64]:
    """The zone of balls (E, 3) from our side: (E,) int.

    -2 and 2 are the penalty areas, -1 and 1 the rest of the outer parts, and 0 is the middle or outside of the pitch.
    """
    x, y = ball[:, 0], np.abs(ball[:, 1])
    side = np.sign(x).astype(np.int64)
    deep = (np.abs(x) > PENALTY_X) & (y < PENALTY_Y)
    outer = np.abs(x) > THIRD_X
    return np.where(_on_pitch(ball), side * (outer.astype(np.int64) + deep), 0)


def available_actions(match: Match) -> NDArray[np.bool_]:
    """(E, N, 19) bool.

    An agent can kick if its player owns the ball, or is near one that nobody owns; dribble if its player owns the ball;
    slide unless its team owns the ball. It can start a sprint or dribbling that has not started, and end it, or its
    direction, if it has.
    """
    owns = (match.owner_team == OURS)[:, None] & (match.owner[:, None] == match.controlled)
    near = np.linalg.norm(_to_ball(match), axis=2) < KICK_DISTANCE
    sprints, dribbles = match.sticky[..., SPRINT], match.sticky[..., DRIBBLE]
    available = np.ones((*owns.shape, N_ACTIONS), dtype=bool)
    available[..., KICKS] = (owns | near & (match.owner_team == NOBODY)[:, None])[..., None]
    available[..., START_SPRINT], available[..., END_SPRINT] = ~sprints, sprints
    available[..., END_DIRECTION] = match.sticky[..., :SPRINT].any(axis=2)
    available[..., SLIDE] = (match.owner_team != OURS)[:, None]
    available[..., START_DRIBBLE], available[..., END_DRIBBLE] = owns & ~dribbles, dribbles
    return available


def observations(match: Match, available: NDArray[np.bool_]) -> Floats:
    """(E, N, C), see the module.

    Args:
        available: `available_actions` of the match.
    """
    team, opponents = match.team, match.opponents
    own = match.of_agents(team.position)
    others = _without_own(_seen(team, own), match.controlled)
    enemies = _seen(opponents, own)
    lead = own.shape[:2]
    groups = [
        available.astype(np.float64),
        _own_player(match),
        _ball(match),
        others.reshape(*lead, -1),
        _nearest(others),
        enemies.reshape(*lead, -1),
        _nearest(enemies),
    ]
    return np.concatenate(groups, axis=2)


def global_state(match: Match) -> Floats:
    """(E, S): ball 6, owner 3, share of the match that is left, mode 7, five numbers of each player, agents' players.

    The five are position, velocity and tiredness, zeros for those who were sent off. The last group has for each agent
    a one-hot number of the player that it controls.
    """
    players = [
        np.concatenate([each.position, _PLAYER_SPEED * each.velocity, each.tired[..., None]], axis=2)
        * each.present[..., None]
        for each in (match.team, match.opponents)
    ]
    groups = [
        match.ball,
        _BALL_SPEED * match.ball_velocity,
        _one_hot(match.owner_team - NOBODY, 3),
        1 - match.elapsed_steps[:, None] / LIMIT_STEPS,
        _one_hot(match.mode, N_MODES),
        *players,
        _one_hot(match.controlled, match.team.tired.shape[1]),
    ]
    return np.concatenate([group.reshape(len(match.ball), -1) for group in groups], axis=1)


def _own_player(match: Match) -> Floats:
    """(E, N, 19)."""
    velocity = _PLAYER_SPEED * match.of_agents(match.team.velocity)
    own = [
        match.of_agents(match.team.position),
        velocity,
        _length(velocity),
        _one_hot(match.of_agents(match.team.role), len(ROLES)),
        match.of_agents(match.team.tired)[..., None],
        _length(_to_ball(match)),
        match.sticky[..., SPRINT:N_STICKY],
    ]
    return np.concatenate(own, axis=2)


def _ball(match: Match) -> Floats:
    """(E, N, 18)."""
    velocity = _BALL_SPEED * match.ball_velocity
    in_goal = (np.abs(match.ball[:, 0]) > _END_X) & (np.abs(match.ball[:, 1]) <= GOAL_Y)
    beyond = np.where(in_goal, 2 * np.sign(match.ball[:, 0]).astype(np.int64), _OUTSIDE)
    zone = np.where(_on_pitch(match.ball), ball_zone(match.ball), beyond)
    alike = [match.ball, velocity, _length(velocity)]
    alike += [_one_hot(zone + 2, 6), _one_hot(match.owner_team - NOBODY, 3)]
    to_ball = _to_ball(match)
    shared = np.concatenate(alike, axis=1)[:, None]
    return np.concatenate([np.broadcast_to(shared, (*to_ball.shape[:2], shared.shape[2])), to_ball], axis=2)


def _seen(players: Players, own: Floats) -> Floats:
    """Players of a team as agents at `own` (E, N, 2) see them: (E, N, P, 7)."""
    lead = (*own.shape[:2], players.tired.shape[1])
    away = players.position[:, None] - own[:, :, None]
    velocity = _PLAYER_SPEED * players.velocity
    same = np.concatenate([velocity, _length(velocity)], axis=2)[:, None]
    tired = players.tired[:, None, :, None]
    parts = [away, np.broadcast_to(same, (*lead, 3)), _length(away), np.broadcast_to(tired, (*lead, 1))]
    return np.concatenate(parts, axis=3) * players.present[:, None, :, None]


def _without_own(seen: Floats, controlled: NDArray[np.int64]) -> Floats:
    """All but each agent's own player: (E, N, P - 1, 7)."""
    players = seen.shape[2]
    kept = np.arange(players - 1) + (np.arange(players - 1) >= controlled[..., None])
    return np.take_along_axis(seen, kept[..., None], axis=2)


def _nearest(seen: Floats) -> Floats:
    """The nearest present player of (E, N, P, 7): (E, N, 7)."""
    distance = np.where(seen.any(axis=3), seen[..., 5], np.inf)
    nearest = distance.argmin(axis=2)[..., None, None]
    return np.take_along_axis(seen, nearest, axis=2)[:, :, 0]


def _to_ball(match: Match) -> Floats:
    """Vectors from the agents' players to the ball: (E, N, 2)."""
    return match.ball[:, None, :2] - match.of_agents(match.team.position)


def _on_pitch(ball: Floats) -> NDArray[np.bool_]:
    return (np.abs(ball[:, 0]) <= _END_X) & (np.abs(ball[:, 1]) <= _END_Y)


def _length(vectors: Floats) -> Floats:
    return np.linalg.norm(vectors, axis=-1, keepdims=True)


def _one_hot(numbers: NDArray[np.int64], size: int) -> Floats:
    return np.eye(size)[numbers]
