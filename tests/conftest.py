"""What every test needs, before torch is imported, and fixtures that folders share."""

import os

from hypothesis import settings

# A thread of torch that waits spins by default. Beside the servers and workers of the tests, which share two cores,
# that made a training ten times slower; one thread that sleeps when it waits is also what the workers are given.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# A busy machine is no failure: the first torch call of a process alone can take a second.
settings.register_profile("unhurried", deadline=None, derandomize=True)
settings.load_profile("unhurried")

pytest_plugins = ["support.mapt_command", "support.short_tasks"]
