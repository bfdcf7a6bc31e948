"""Timing of calls that are compared. They alternate, so that other load slows them equally."""

import statistics
from collections.abc import Callable


def median_seconds(clock: Callable[[], float], rounds: int, *calls: Callable[[], object]) -> list[float]:
    """Median seconds of each call, after one warm-up round.

    Args:
        clock: `time.perf_counter` or `time.process_time`.
    """
    timings: list[list[float]] = [[] for _ in calls]
    for _ in range(rounds + 1):
        for call, seconds in zip(calls, timings, strict=True):
            started = clock()
            call()
            seconds.append(clock() - started)
    return [statistics.median(seconds[1:]) for seconds in timings]
