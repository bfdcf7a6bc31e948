"""Settings of runs that take less than a second."""

from collections.abc import Callable

import pytest

from mapt.policies import PolicyConfig
from mapt.training.settings import RunSettings
from support.short_tasks import SHORTEST_NAME
from support.training_runs import STEPS_PER_ITERATION


@pytest.fixture(autouse=True)
def use_short_episodes(short_episodes: None) -> None:
    """Shorten the episodes in every test of this folder, since runs play whole episodes."""


@pytest.fixture
def settings() -> Callable[..., RunSettings]:
    """A function that makes the settings of a tiny run.

    Its arguments override fields of `RunSettings`; those that start with `policy_` override fields of `PolicyConfig`.
    """

    def make(iterations: int = 3, **changes: object) -> RunSettings:
        policy = {name.removeprefix("policy_"): changes.pop(name) for name in list(changes) if name[:7] == "policy_"}
        tiny = {"n_envs": 4, "rollout_steps": 24, "minibatches": 2, "epochs": 2, "hidden": [8], "device": "cpu"}
        config = PolicyConfig.named(str(policy.pop("algorithm", "mappo")), **{**tiny, **policy})
        return RunSettings(task=SHORTEST_NAME, policy=config, steps=iterations * STEPS_PER_ITERATION, **changes)  # pyright: ignore[reportArgumentType]

    return make
