"""Timings that are compared take turns, so that a busy machine slows them alike."""

import statistics
from collections.abc import Callable


def median_seconds(clock: Callable[[], float], rounds: int, *calls: Callable[[], object]) -> list[float]:
    """Median seconds of each call, by `time.perf_counter` or `time.process_time`, after a round that is not counted."""
    seen: list[list[float]] = [[] for _ in calls]
    for _ in range(rounds + 1):
        for call, seconds in zip(calls, seen, strict=True):
            started = clock()
            call()
            seconds.append(clock() - started)
    return [statistics.median(seconds[1:]) for seconds in seen]
