"""Settings in a TOML file, sweeps over them, and the shares of them that parallel commands take."""

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Annotated, Any, TypeVar

from mapt.errors import InvalidConfig
from mapt.policies.config import PolicyConfig
from mapt.rewards.model import PolicyReward
from mapt.rewards.relabelling import Credit
from mapt.settings import DEVICE_DESCRIPTION, Device, Settings, parse_value, setting
from mapt.tasks.registry import DEFAULT_AGENT_OBSK, task_spec
from mapt.training.settings import TRUE

T = TypeVar("T")

#: characters of values that folder names keep, besides letters and digits
_IN_NAMES = "+-.,=_[]"


@dataclass(frozen=True, slots=True)
class RewardChoice(Settings):
    """The reward that a policy trains on."""

    path: Annotated[
        str,
        setting("true for the task's own reward, or a folder or .safetensors file of a reward model.", min_length=1),
    ] = TRUE
    segment_steps: Annotated[
        int | None, setting("Segment length T of the reward model; null for that of its reward.json.", unit="steps")
    ] = None
    kind: Annotated[PolicyReward, setting("Output of the reward model to train on.")] = "value"
    credit: Annotated[
        Credit, setting("shared: every agent gets the mean reward. individual: each agent gets its own.")
    ] = "shared"


@dataclass(frozen=True, slots=True)
class RunFile(Settings):
    """The settings of the runs of `mapt train`, as a TOML file has them.

    Raises:
        InvalidConfig: if a value has the wrong type or is out of its range; `field` names the setting.
    """

    task: Annotated[str, setting("Task name; `mapt tasks` lists them.", min_length=1)] = "HalfCheetah-6x1"
    steps: Annotated[int, setting("Environment steps to train each policy for.", ge=1, unit="steps")] = 1_000_000
    seeds: Annotated[tuple[int, ...], setting("Random seeds, a run for each.", min_length=1)] = (0,)
    agent_obsk: Annotated[int, setting("How many joints away an agent observes; MuJoCo tasks only.", ge=0)] = (
        DEFAULT_AGENT_OBSK
    )
    evaluate_every_steps: Annotated[
        int, setting("Environment steps between evaluations; 0 evaluates only at the end.", ge=0, unit="steps")
    ] = 0
    device: Annotated[Device, setting(DEVICE_DESCRIPTION)] = "auto"
    policy: Annotated[
        dict[str, Any],
        setting("`algorithm`, and settings that differ from its defaults and the task's.", overrides=PolicyConfig),
    ] = field(default_factory=dict[str, Any])
    reward: RewardChoice = field(default_factory=RewardChoice)
    initial_policy: Annotated[
        str,
        setting(
            "Policy to start from: the folder of a run of the same task, or a checkpoint. Empty: an untrained policy."
        ),
    ] = ""

    def check(self) -> None:
        """Check the policy's settings, and that no seed is repeated. Raises InvalidConfig."""
        for name, own in (("seed", "seeds"), ("device", "device")):
            if name in self.policy:
                raise InvalidConfig(f"policy.{name}: use {own}, outside of policy.", f"policy.{name}")
        if len(set(self.seeds)) != len(self.seeds) or min(self.seeds) < 0:
            raise InvalidConfig(f"seeds is {list(self.seeds)}; each must be 0 or more, without repeats.", "seeds")
        self.policy_config(self.seeds[0])

    def policy_config(self, seed: int, initial: Mapping[str, object] | None = None) -> PolicyConfig:
        """The policy's settings of one run; see `PolicyConfig.for_task`. Raises InvalidConfig."""
        spec = task_spec(self.task, agent_obsk=self.agent_obsk)
        return PolicyConfig.for_task(spec, {**self.policy, "device": self.device, "seed": seed}, initial)


def read_toml(path: Path) -> dict[str, Any]:
    """The settings in a TOML file.

    Raises:
        InvalidConfig: if there is no such file, or it is not TOML.
    """
    try:
        return tomllib.loads(path.read_text())
    except OSError as error:
        raise InvalidConfig(f"{path} cannot be read: {error.strerror}.") from error
    except ValueError as error:
        raise InvalidConfig(f"{path} is not TOML: {error}.") from error


def merged(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`settings` changed by `changes`; nested settings are merged likewise."""
    both = dict(settings)
    for name, value in changes.items():
        inner = both.get(name)
        both[name] = merged(inner, value) if isinstance(inner, Mapping) and isinstance(value, Mapping) else value
    return both


@dataclass(frozen=True, slots=True)
class Sweep:
    """A setting and the values that it takes, one after another."""

    name: str
    values: tuple[object, ...]

    @classmethod
    def parse(cls, text: str) -> "Sweep":
        """Parse NAME=VALUE,VALUE. Values are numbers, true, false, null or lists as JSON writes them, or else texts.

        Raises:
            InvalidConfig: if there is no name, an empty value, or a repeated one.
        """
        name, equals, written = text.partition("=")
        name = name.strip()
        if not equals or not name:
            raise InvalidConfig(f"{text!r} is not a sweep. Write NAME=VALUE,VALUE, such as learning_rate=1e-3,2e-3.")
        try:
            values = tuple(json.loads(f"[{written}]"))
        except ValueError:
            values = tuple(parse_value(part) for part in written.split(","))
        shown = [json.dumps(value) for value in values]
        if not values or '""' in shown or len(set(shown)) != len(shown):
            raise InvalidConfig(f"The sweep {text!r} has an empty or repeated value.", name)
        return cls(name, values)


@dataclass(frozen=True, slots=True)
class Cell:
    """One combination of the values of a sweep."""

    #: NAME=VALUE,NAME=VALUE, fit for a folder's name; empty without a sweep
    name: str
    #: settings, nested as in the file
    settings: dict[str, Any]


def cells(settings: Mapping[str, Any], sweeps: Sequence[Sweep], top_level: Sequence[str]) -> list[Cell]:
    """Every combination of the values of `sweeps`, as changes of `settings`; the last sweep's values change fastest.

    Args:
        top_level: names of settings that are not nested. A name with a dot is nested, such as `reward.credit`; any
            other is a setting of `policy`.

    Raises:
        InvalidConfig: if a setting is swept twice, or two combinations have the same name.
    """
    places = [
        sweep.name if "." in sweep.name or sweep.name in top_level else f"policy.{sweep.name}" for sweep in sweeps
    ]
    if len(set(places)) < len(places):
        raise InvalidConfig(f"The sweeps of {', '.join(sweep.name for sweep in sweeps)} name a setting twice.")
    found: list[Cell] = []
    for values in product(*(sweep.values for sweep in sweeps)):
        changed = dict(settings)
        for place, value in zip(places, values, strict=True):
            outer, _, inner = place.partition(".")
            changed = merged(changed, {outer: {inner: value} if inner else value})
        name = ",".join(f"{sweep.name}={_in_name(value)}" for sweep, value in zip(sweeps, values, strict=True))
        found.append(Cell(name, changed))
    if len({cell.name for cell in found}) < len(found):
        raise InvalidConfig("Two values of a sweep would have the same folder; change the names of their files.")
    return found


def share(items: Sequence[T], which: str) -> Sequence[T]:
    """The part of `items` that the Kth of N commands takes, for `which` = K/N: the Kth of every N.

    Raises:
        InvalidConfig: if `which` is not K/N with 1 <= K <= N.
    """
    first, slash, count = which.partition("/")
    if not slash or not first.isdecimal() or not count.isdecimal() or not 1 <= int(first) <= int(count):
        raise InvalidConfig(f"--only {which!r} must be K/N, such as 3/12: the third of twelve parts.", "only")
    return items[int(first) - 1 :: int(count)]


def _in_name(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
    return "".join(each if each.isalnum() or each in _IN_NAMES else "_" for each in text)
