"""Runs small enough for a test."""

from collections.abc import Callable

import pytest

from mapt.policies import PolicyConfig
from mapt.training.settings import RunSettings
from support.short_tasks import SHORTEST_NAME
from support.training_runs import STEPS_PER_ITERATION


@pytest.fixture(autouse=True)
def every_test_has_short_episodes(short_episodes: None) -> None:
    """Each plays whole episodes."""


@pytest.fixture
def settings() -> Callable[..., RunSettings]:
    """Makes the settings of a tiny run; what is given goes to `RunSettings`, `policy_...` to the policy's."""

    def make(iterations: int = 3, **changes: object) -> RunSettings:
        policy = {name.removeprefix("policy_"): changes.pop(name) for name in list(changes) if name[:7] == "policy_"}
        tiny = {"n_envs": 4, "rollout_steps": 24, "minibatches": 2, "epochs": 2, "hidden": [8], "device": "cpu"}
        config = PolicyConfig.named(str(policy.pop("algorithm", "mappo")), **{**tiny, **policy})
        return RunSettings(task=SHORTEST_NAME, policy=config, steps=iterations * STEPS_PER_ITERATION, **changes)  # pyright: ignore[reportArgumentType]

    return make
