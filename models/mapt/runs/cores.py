"""How a machine's cores are shared out; without torch, so that any process may ask."""

import os

#: For processes whose OpenMP threads should be good neighbours. By default they spin for milliseconds while they
#: wait for each other: where other programs use the same cores, that made a training of two threads ten times slower
#: (127 s beside 12 s with sleeping threads, 8 processes on 2 cores). Threads that sleep at once are slow where cores
#: are idle: two train on 98 pairs a second, one on 104, two that spin on 167. These spin for tenths of a millisecond
#: (148), and lose nothing beside other programs (37 to 41; asleep 34 to 37).
PATIENT_THREADS = {"GOMP_SPINCOUNT": "10000"}


def at_once(asked: int, n_jobs: int) -> int:
    """How many of some jobs are done at once where `asked` are asked for: 0 is for one per core."""
    return max(1, min(asked or os.cpu_count() or 1, n_jobs))


def cores_of_each(n_at_once: int) -> int:
    """Threads that step the task of each of so many jobs."""
    return max(1, (os.cpu_count() or 1) // n_at_once)
