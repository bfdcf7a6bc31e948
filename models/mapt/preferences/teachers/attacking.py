"""A rule for the tasks whose names begin with Football-: attempts should come close to a goal."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidTeacher, MissingArray
from mapt.preferences.teachers.rules import Rule
from mapt.preferences.teachers.view import Float64s, TeacherView

#: Columns and values of a football task's qpos, as in `mapt.tasks.football.match`; importing that would load mujoco.
BALL, BALL_VELOCITY, OWNER_TEAM, GOALS, MODE = slice(0, 2), slice(3, 5), 6, slice(8, 10), 11
NOBODY, OURS, THEIRS, NORMAL = -1, 0, 1, 0
#: metres per unit of x and y; the opponents' goal and half its width, in units
METRES = np.array([54.4, 83.6])
GOAL, GOAL_Y = np.array([1.0, 0.0]), 0.044
#: metres per second of a kicked ball that count as a shot, and steps per second
SHOT_SPEED, STEPS_PER_SECOND = 10.0, 10


@dataclass(frozen=True, slots=True)
class Attacking(Rule):
    """Prefers attempts that come closer to a goal, as a person would who watches a clip.

    A segment is worth `goal` for each goal of ours, less each of theirs; `shot` for each kick of ours that sends the
    ball between the posts at 10 m/s or more; and the most by which the threat rises above that of its first state,
    while the ball is in play and was not last the opponents'. The threat is exp(-d / `threat_metres`) for a ball that
    is d metres from the opponents' goal.

    An attempt that fails loses nothing that it gained. When it did, the end of an attempt, which is nearly always a
    failure at first, was worse than anything else, and a team learned to keep the ball away from everyone
    (docs/results/benchmark-tasks.md, "Football").
    """

    goal: float = 3.0
    shot: float = 1.0
    threat_metres: float = 20.0

    def __post_init__(self) -> None:
        if self.threat_metres <= 0:
            raise InvalidTeacher(f"threat_metres is {self.threat_metres}; it must be above 0.")

    @property
    def reads(self) -> tuple[str, ...]:
        return ("qpos",)

    @property
    def task_prefix(self) -> str:
        return "Football-"

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        states = view.require("qpos").astype(np.float64)
        if states.shape[2] <= MODE:
            raise MissingArray("the ball and the goals of a match (tasks whose names begin with Football-)")
        last = states[np.arange(len(states)), view.lengths - 1]
        goals = last[:, GOALS] - states[:, 0, GOALS]
        shots = (self._shots(states) & view.mask[:, 1:]).sum(axis=1)
        threat = np.exp(-np.linalg.norm((states[..., BALL] - GOAL) * METRES, axis=2) / self.threat_metres)
        attacks = view.mask & (_last_owners(states) != THEIRS) & (states[..., MODE] == NORMAL)
        # Not negative: the first step counts 0.
        risen = np.where(attacks, threat - threat[:, :1], 0.0).max(axis=1)
        return self.goal * (goals[:, 0] - goals[:, 1]) + self.shot * shots + risen

    @staticmethod
    def _shots(states: Float64s) -> NDArray[np.bool_]:
        """Whether each step but the last of states (B, T, nq) is a kick of ours on target, (B, T - 1)."""
        owner, ball, velocity = states[..., OWNER_TEAM], states[..., BALL], states[..., BALL_VELOCITY]
        kicked = (owner[:, :-1] == OURS) & (owner[:, 1:] == NOBODY)
        ball, velocity = ball[:, 1:], velocity[:, 1:]
        fast = np.linalg.norm(velocity * METRES, axis=2) * STEPS_PER_SECOND >= SHOT_SPEED
        forward = velocity[..., 0] > 0
        steps = np.divide(1.0 - ball[..., 0], velocity[..., 0], out=np.zeros(forward.shape), where=forward)
        on_target = np.abs(ball[..., 1] + steps * velocity[..., 1]) <= GOAL_Y
        return kicked & fast & forward & on_target


def _last_owners(states: Float64s) -> Float64s:
    """The team that had the ball last, (B, T) of states (B, T, nq); NOBODY where none had it yet."""
    owners = states[..., OWNER_TEAM]
    owned = np.maximum.accumulate(np.where(owners == NOBODY, 0, np.arange(owners.shape[1])), axis=1)
    return np.take_along_axis(owners, owned, axis=1)
