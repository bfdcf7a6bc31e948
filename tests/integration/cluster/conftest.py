"""A Ray cluster of several nodes on this machine. Ray is the extra `ray`, which `make test-ray` installs."""

import os
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from mapt.cluster import load_ray
from support import short_tasks

#: less than the least that Ray takes by default, a third of the machine's memory
NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
#: for commands on the cluster; nodes inherit it too
ENVIRONMENT = os.environ | short_tasks.ENVIRONMENT | {"OMP_NUM_THREADS": "1"}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if find_spec("ray") is None:
        for item in items:
            if "integration/cluster" in str(item.path):
                item.add_marker(pytest.mark.skip(reason="ray is not installed (make test-ray)"))


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A `ray.cluster_utils.Cluster` with a head without cores and no other node."""
    with pytest.MonkeyPatch.context() as patch:
        # By default, Ray's workers come after all other programs.
        patch.setenv("RAY_worker_niceness", "0")
        # A node that is killed counts as dead after half a second of silence times five, instead of half a minute.
        patch.setenv("RAY_health_check_period_ms", "500")
        patch.setenv("RAY_health_check_initial_delay_ms", "500")
        # Jobs of these tests are functions of their modules.
        patch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
        for name, value in short_tasks.ENVIRONMENT.items():
            patch.setenv(name, value)
        ray = load_ray()
        made = import_module("ray.cluster_utils").Cluster(
            initialize_head=True, head_node_args=NODE | {"num_cpus": 0, "include_dashboard": False}
        )
        try:
            yield made
        finally:
            ray.shutdown()
            made.shutdown()
