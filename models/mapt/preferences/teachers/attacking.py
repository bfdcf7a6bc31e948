"""A rule for the tasks whose names begin with Football-: attempts should come nearer to a goal, to shots and goals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidTeacher, MissingArray
from mapt.preferences.teachers.rules import Rule
from mapt.preferences.teachers.view import Float64s, TeacherView

#: Columns of a football task's qpos, see `mapt.tasks.football.match`: importing mapt.tasks here would load mujoco.
BALL, BALL_VELOCITY, OWNER_TEAM, GOALS, MODE = slice(0, 2), slice(3, 5), 6, slice(8, 10), 11
NOBODY, OURS, THEIRS, NORMAL = -1, 0, 1, 0
#: metres per unit of x and y; the opponents' goal and half its width, in units
METRES = np.array([54.4, 83.6])
GOAL, GOAL_Y = np.array([1.0, 0.0]), 0.044
#: metres per second of a kicked ball that count as a shot, and steps per second
SHOT_SPEED, STEPS_PER_SECOND = 10.0, 10


@dataclass(frozen=True, slots=True)
class Attacking(Rule):
    """Prefers attempts that come nearer to a goal, as a person would who watches a clip.

    A segment is worth `goal` for each goal of ours, less each of theirs; `shot` for each kick of ours that sends the
    ball between the posts at 10 m/s or more; and what is gained in nearness, from the first to the last state: 1 at the
    opponents' goal and 0 from `far_metres` away, and 0 once the attempt has failed, because the opponents have the ball
    or it has left the pitch.

    Nearness is gained, not held: a team that stays near the goal gets nothing more for each further second. So the
    rewards per step that explain such preferences are shaped by a potential (Ng, Harada and Russell 1999), and do not
    change which team is best.
    """

    goal: float = 3.0
    shot: float = 1.0
    far_metres: float = 40.0

    def __post_init__(self) -> None:
        if self.far_metres <= 0:
            raise InvalidTeacher(f"far_metres is {self.far_metres}; it must be above 0.")

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
        last = view.lengths - 1
        goals = _at(states, last)[:, GOALS] - states[:, 0, GOALS]
        shots = (self._shots(states) & view.mask[:, 1:]).sum(axis=1)
        nearer = self._nearness(_at(states, last)) - self._nearness(states[:, 0])
        return self.goal * (goals[:, 0] - goals[:, 1]) + self.shot * shots + nearer

    def _nearness(self, states: Float64s) -> Float64s:
        """(B,) of states (B, nq)."""
        metres = np.linalg.norm((states[:, BALL] - GOAL) * METRES, axis=1)
        failed = (states[:, OWNER_TEAM] == THEIRS) | (states[:, MODE] != NORMAL)
        return np.where(failed, 0.0, np.clip(1.0 - metres / self.far_metres, 0.0, 1.0))

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


def _at(states: Float64s, steps: NDArray[np.int64]) -> Float64s:
    """The states (B, nq) at one step (B,) of each segment."""
    return states[np.arange(len(states)), steps]
