"""The true reward of football, that of the paper's benchmark."""

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.football.features import ball_zone
from mapt.tasks.football.match import OURS, Match

WIN_REWARD, GOAL_REWARD = 5.0, 5.0
#: weights of the ball's zone and of the distance to the ball
ZONE_WEIGHT, DISTANCE_WEIGHT = 0.003, 0.003


def team_reward(before: Match, after: Match, over: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The reward of a step of E matches.

    5 w + 5 g + c + 0.003 z - 0.003 d, where w is the sign of the difference in goals if the match is over, g the change
    of this difference, c how many more yellow cards the opponents got than we, z the ball's zone from -2 to 2, and d,
    unless our team owns the ball, the distance of our nearest player from it.

    Args:
        before, after: the states before and after the step.
        over: bool (E,): the step ended the match.

    Returns:
        (E,).
    """
    lead = after.goals[:, 0] - after.goals[:, 1]
    scored = lead - (before.goals[:, 0] - before.goals[:, 1])
    carded = _new_cards(before.opponents.carded, after.opponents.carded)
    carded -= _new_cards(before.team.carded, after.team.carded)
    apart = np.linalg.norm(after.team.position - after.ball[:, None, :2], axis=2)
    nearest = np.where(after.team.present, apart, np.inf).min(axis=1)
    return (
        WIN_REWARD * np.sign(lead) * over
        + GOAL_REWARD * scored
        + carded
        + ZONE_WEIGHT * ball_zone(after.ball)
        - DISTANCE_WEIGHT * nearest * (after.owner_team != OURS)
    )


def _new_cards(before: NDArray[np.bool_], after: NDArray[np.bool_]) -> NDArray[np.float64]:
    return after.sum(axis=1, dtype=np.float64) - before.sum(axis=1)
