"""When labels are asked for.

A quarter of the budget before the policy learns anything and the rest at a falling rate as it changes
(Christiano et al. 2017: labels given only at the start worked badly, since the policy leaves the states they
were given on).
"""

from dataclasses import dataclass
from math import floor


@dataclass(frozen=True, slots=True)
class LabelSchedule:
    """How many labels are due by a step of the policy's training."""

    #: labels in all
    budget: int
    #: labels before the first reward version
    initial: int
    #: environment steps of the whole run
    total_steps: int
    #: the last label is due at this share of the run: later ones could no longer teach the policy much
    last_at: float = 0.75
    #: below 1, early steps ask for more labels than late ones
    exponent: float = 0.7

    def due(self, steps: int) -> int:
        """Labels due when the policy has taken `steps` environment steps: from `initial` up to `budget`."""
        progress = min(1.0, steps / (self.last_at * self.total_steps))
        return self.initial + floor((self.budget - self.initial) * progress**self.exponent)
