"""By what a teacher judges."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from mapt.preferences.teachers.evidence import Evidence, Float64s


@dataclass(frozen=True, slots=True)
class Rule(ABC):
    """What makes one segment better than another. The fields of a rule are its parameters."""

    @property
    @abstractmethod
    def reads(self) -> tuple[str, ...]:
        """Fields of Evidence that it judges by."""

    @property
    def is_return(self) -> bool:
        """True where scores are true returns, so that 0 means that nothing was achieved."""
        return False

    @abstractmethod
    def scores(self, evidence: Evidence) -> Float64s:
        """Score of each segment, float64 (B,): the larger, the better. Padding does not change it.

        Raises:
            MissingEvidence: if the evidence lacks what the rule reads.
        """


class RewardRule(Rule):
    """A rule about the course of the true reward."""

    __slots__ = ()

    @property
    def reads(self) -> tuple[str, ...]:
        return ("rewards",)
