"""Teachers by name: B-Pref's six, one for each rule, and both together, as in `phase+mistake`."""

import math
from dataclasses import fields, replace
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from mapt.errors import InvalidTeacher, UnknownTeacher
from mapt.preferences.teachers.cooperation import FindsPhase, NobodyIdle, Phase, SharedLoad
from mapt.preferences.teachers.history import BestSecond, Never, Recency, Return, Smoothness, WorstSecond
from mapt.preferences.teachers.rule import Rule
from mapt.preferences.teachers.scripted import Habits, ScriptedTeacher

Settings = TypeVar("Settings", Habits, Rule)

#: B-Pref's teachers (Lee et al. 2021, table 1).
PRESETS = {
    "oracle": Habits(),
    "stochastic": Habits(beta=1.0),
    "mistake": Habits(mistake=0.1),
    "skip": Habits(skip=0.1),
    "myopic": Habits(gamma=0.9),
    "equal": Habits(equal=0.1),
}

#: Rules with the parameters they have when nobody says. Columns are those of HalfCheetah-6x1 with its neighbours in
#: sight: 4 is the height of the torso over its rest, in metres, 5 its pitch, in radians.
RULES: dict[str, Rule] = {
    "return": Return(),
    "best-second": BestSecond(),
    "worst-second": WorstSecond(),
    "recency": Recency(),
    "smoothness": Smoothness(),
    "never-falls": Never(column=4, limit=-0.18, side="below"),
    "never-tips": Never(column=5, limit=0.3, side="beyond"),
    "phase": Phase(),
    "finds-phase": FindsPhase(),
    "shared-load": SharedLoad(),
    "nobody-idle": NobodyIdle(),
}


def teacher_names() -> tuple[str, ...]:
    """Names of the presets, then of the rules. One of each may be joined by a plus: `phase+mistake`."""
    return (*PRESETS, *(name for name in RULES if name != "return"))


def make_teacher(name: str, /, *, seed: int = 0, **parameters: Any) -> ScriptedTeacher:
    """The teacher with this name.

    Args:
        name: a preset, which judges by true return; a rule, which it follows without fail; or `rule+preset`.
        seed: of its chance, also for teachers that leave nothing to chance.
        parameters: fields of `Habits` and of the rule, in place of the name's own.

    Raises:
        UnknownTeacher: if no teacher has this name.
        InvalidTeacher: if it has no such parameter, or not with this value.
    """
    rule_name, preset_name = _parts(name)
    seed = _typed(name, "seed", int, seed)
    if seed < 0:
        raise InvalidTeacher(f"seed must be 0 or more, got {seed}")
    habits, rule = PRESETS[preset_name], RULES[rule_name]
    of_habits = {field.name for field in fields(Habits)}
    habits = _changed(habits, {key: value for key, value in parameters.items() if key in of_habits}, name)
    rule = _changed(rule, {key: value for key, value in parameters.items() if key not in of_habits}, name)
    record = {"name": name, "rule": rule_name, "seed": seed}
    return ScriptedTeacher(rule, habits, np.random.default_rng(seed), record)


def _parts(name: str) -> tuple[str, str]:
    """Rule and preset of a teacher's name."""
    first, plus, second = name.partition("+")
    if plus:
        if first in RULES and second in PRESETS:
            return first, second
    elif first in PRESETS:
        return "return", first
    elif first in RULES:
        return first, "oracle"
    raise UnknownTeacher(name, teacher_names())


def _changed(settings: Settings, changes: dict[str, Any], name: str) -> Settings:
    """These settings with some fields changed, each to a value of its type."""
    hints = get_type_hints(type(settings))
    known = [field.name for field in fields(settings)]
    if unknown := changes.keys() - set(known):
        there = f"beside {', '.join(field.name for field in fields(Habits))} it has {', '.join(known) or 'none'}"
        raise InvalidTeacher(f"{name} has no parameter {', '.join(sorted(unknown))}; {there}")
    return replace(settings, **{key: _typed(name, key, hints[key], value) for key, value in changes.items()})


def _typed(name: str, key: str, hint: Any, value: Any) -> Any:
    """This value as the type that the field asks for."""
    choices = get_args(hint) if get_origin(hint) is Literal else ()
    number = isinstance(value, int | float | np.integer) and not isinstance(value, bool) and math.isfinite(value)
    if hint == (float | None) and value is None:
        return None
    if hint in (float, float | None) and number:
        return float(value)
    if (hint is int and number and value == int(value)) or value in choices:
        return int(value) if hint is int else value
    if hint == tuple[int, ...] and isinstance(value, list | tuple) and all(isinstance(item, int) for item in value):
        return tuple(value)
    wanted = " or ".join(map(repr, choices)) or {int: "a whole number", tuple[int, ...]: "a list of whole numbers"}.get(
        hint, "a number"
    )
    raise InvalidTeacher(f"{key} of {name} must be {wanted}, got {value!r}")
