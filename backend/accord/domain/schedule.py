"""When labels are asked for.

Some of the budget before the policy learns anything, a quarter for example, and the rest as it changes (Christiano et
al. 2017: labels given only at the start worked badly, since the policy leaves the states they were given on).
"""

from dataclasses import dataclass
from math import floor, log1p
from typing import Literal

#: power: the rate falls gently, as progress^-0.3; constant: it stays; decaying: it falls as 1 / (steps + a tenth of
#: the run) (Christiano et al. 2017)
LabelScheduleName = Literal["power", "constant", "decaying"]


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
    #: see `LabelScheduleName`; one that is none of them counts as `power`
    name: LabelScheduleName = "power"
    #: of a decaying rate: it has fallen to half after this share of the run
    halved_at: float = 0.1

    def due(self, steps: int) -> int:
        """Labels due when the policy has taken `steps` environment steps: from `initial` up to `budget`."""
        progress = min(1.0, steps / (self.last_at * self.total_steps))
        return self.initial + floor((self.budget - self.initial) * self._share(progress))

    def _share(self, progress: float) -> float:
        """Of the labels after the first ones, how many are due: from 0 to 1 as progress goes from 0 to 1."""
        if self.name == "constant":
            return progress
        if self.name == "decaying":
            # the integral of 1 / (t + c), from 0 on, in units of the whole
            c = self.halved_at / self.last_at
            return log1p(progress / c) / log1p(1 / c)
        return progress**self.exponent
