"""How long to leave alone what just failed."""

import random
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Backoff:
    """Doubling pauses with jitter, so that what failed together is not tried again together."""

    first_seconds: float = 0.5
    longest_seconds: float = 30.0

    def seconds(self, failures: int, rng: random.Random) -> float:
        """The pause after so many failures in a row, at least 1: between a half and the whole of the step."""
        step = min(self.longest_seconds, self.first_seconds * 2.0 ** min(failures - 1, 30))
        return step * rng.uniform(0.5, 1.0)
