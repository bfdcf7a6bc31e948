"""Rules about how the agents of a segment worked together."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapt.errors import MissingEvidence
from mapt.preferences.teachers.evidence import Evidence, Float64s
from mapt.preferences.teachers.history import SECOND_STEPS
from mapt.preferences.teachers.rule import Rule
from mapt.preferences.teachers.windows import check_window, last_means, real_means, window_means

#: What an agent does in a step: |torque x velocity| of its joints, |torque|, or |velocity|.
Effort = Literal["power", "action", "speed"]


@dataclass(frozen=True, slots=True)
class Phase(Rule):
    """Two agents that swing against each other, or together: the correlation of what they observe over the segment."""

    @property
    def reads(self) -> tuple[str, ...]:
        return ("observations",)

    #: column of the observation; MaMuJoCo's 1 is the velocity of an agent's first joint
    column: int = 1
    #: the first agent; and the second, or -1 for the one half a team further on (HalfCheetah's two thighs)
    first_agent: int = 0
    second_agent: int = -1
    #: which is better: opposite or equal courses
    want: Literal["opposite", "equal"] = "opposite"

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`; between -1 and 1, and 0 where one of the two does not move."""
        return real_means(self.accord(evidence), evidence.mask)

    def accord(self, evidence: Evidence) -> Float64s:
        """What each step adds to the correlation, turned so that more is better: float64 (B, T), 0 in padding."""
        half_a_team = self.first_agent + evidence.seen("observations").shape[2] // 2
        second = half_a_team if self.second_agent < 0 else self.second_agent
        courses = evidence.columns((self.column,), (self.first_agent, second))[..., 0]
        courses = np.where(evidence.mask[:, :, None], courses - real_means(courses, evidence.mask)[:, None], 0.0)
        together = courses.prod(axis=2)
        scale = np.sqrt(real_means(np.square(courses), evidence.mask).prod(axis=1))[:, None]
        course = np.divide(together, scale, out=np.zeros_like(together), where=scale > 0)
        return -course if self.want == "opposite" else course


@dataclass(frozen=True, slots=True)
class FindsPhase(Phase):
    """Two agents that come to swing as they should: their last second against the whole segment, as by `Phase`.

    Co-operation over time: no step alone tells anything of it, nor does any agent alone.
    """

    window_steps: int = SECOND_STEPS

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`; 0 where one of the two does not move."""
        accord = self.accord(evidence)
        return last_means(accord, evidence.mask, self.window_steps) - real_means(accord, evidence.mask)


@dataclass(frozen=True, slots=True)
class SharedLoad(Rule):
    """The segment whose agents did equal shares of the work: least spread of their totals, relative to the mean."""

    effort: Effort = "power"

    @property
    def reads(self) -> tuple[str, ...]:
        return _reads(self.effort)

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`; 0 where all do the same, or nothing."""
        totals = real_means(_efforts(evidence, self.effort), evidence.mask)
        mean = totals.mean(axis=1)
        return -np.divide(totals.std(axis=1), mean, out=np.zeros_like(mean), where=mean > 0)


@dataclass(frozen=True, slots=True)
class NobodyIdle(Rule):
    """The segment in which at no time one agent rests while the others work.

    The idlest agent's effort in any one window, relative to the mean of all in that window.
    """

    effort: Effort = "power"
    window_steps: int = SECOND_STEPS // 2

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    @property
    def reads(self) -> tuple[str, ...]:
        return _reads(self.effort)

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`; between 0 and 1, and 1 where all do the same, or nothing."""
        means, starts = window_means(_efforts(evidence, self.effort), evidence.mask, self.window_steps)
        idlest, all_of_them = means.min(axis=2), means.mean(axis=2)
        share = np.divide(idlest, all_of_them, out=np.ones_like(idlest), where=all_of_them > 0)
        return np.where(starts, share, 1.0).min(axis=1)


def _reads(effort: Effort) -> tuple[str, ...]:
    return {"power": ("observations", "actions"), "action": ("actions",), "speed": ("observations",)}[effort]


def _efforts(evidence: Evidence, effort: Effort) -> Float64s:
    """(B, T, N), 0 in padding.

    An agent with A joints observes position and velocity of one after the other (MaMuJoCo), so that their velocities
    stand in columns 1, 3, ..., 2A - 1.
    """
    actions = evidence.seen("actions").astype(np.float64)
    actions = np.where(evidence.mask[:, :, None, None], actions, 0.0)
    if effort == "action":
        return np.abs(actions).sum(axis=3)
    n_joints = actions.shape[3]
    if evidence.seen("observations").shape[3] < 2 * n_joints:
        raise MissingEvidence(f"the velocities of {n_joints} joints")
    velocities = evidence.columns(range(1, 2 * n_joints, 2))
    return np.abs(velocities if effort == "speed" else actions * velocities).sum(axis=3)
