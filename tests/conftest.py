"""Settings for all tests that must precede the first import of torch, and fixtures that several folders share."""

import gc
import os
import secrets

import pytest
from hypothesis import settings

from support.ci import IN_CI

# By default, torch's waiting threads spin. Beside the servers and workers of the tests, on two cores, that made
# training ten times slower. The workers get the same two settings.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# No deadlines: the first torch call of a process can take a second on a busy machine.
# Locally, examples are always the same. In CI they are random, from the seed in the report's header; to reproduce a
# failure: pytest --hypothesis-profile ci --hypothesis-seed SEED TEST.
settings.register_profile("local", deadline=None, derandomize=True)
settings.register_profile("ci", deadline=None, derandomize=False, print_blob=True)
settings.load_profile("ci" if IN_CI else "local")

#: passes the seed to pytest-xdist's processes
SEED_VARIABLE = "ACCORD_TESTS_HYPOTHESIS_SEED"

pytest_plugins = ["support.mapt_command", "support.short_tasks"]


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Draw Hypothesis's seed in CI before its plugin reads the option."""
    if IN_CI and config.option.hypothesis_seed is None:
        config.option.hypothesis_seed = os.environ.setdefault(SEED_VARIABLE, str(secrets.randbelow(2**32)))


def pytest_collection_finish() -> None:
    """Exempt what was imported from garbage collections, which took a sixth of the time of tests of the API."""
    gc.freeze()


def pytest_report_header(config: pytest.Config) -> str:
    if settings.get_current_profile_name() != "ci":
        return "hypothesis: the same examples in every run"
    return f"hypothesis: reproduce with --hypothesis-profile ci --hypothesis-seed {config.option.hypothesis_seed}"
