"""Scripted teachers: label pairs of segments by a rule, with B-Pref's models of human error.

`make_teacher("phase+mistake", seed=0, mistake=0.05).judge(first, second)` labels the pairs of two `TeacherView`s.
"""

from mapt.preferences.teachers.attacking import Attacking
from mapt.preferences.teachers.carrying import Carrying
from mapt.preferences.teachers.rules import (
    BestWindow,
    EffortBalance,
    FinalWindow,
    LowEffort,
    MinimumEffort,
    NeverExceeds,
    Phase,
    PhaseImprovement,
    Return,
    Rule,
    Smoothness,
    WorstWindow,
)
from mapt.preferences.teachers.scripted import (
    PRESETS,
    RULES,
    BPrefParameters,
    OracleTeacher,
    ScriptedTeacher,
    Teacher,
    make_teacher,
    teacher_names,
)
from mapt.preferences.teachers.view import TeacherView

__all__ = [
    "PRESETS",
    "RULES",
    "Attacking",
    "BPrefParameters",
    "BestWindow",
    "Carrying",
    "EffortBalance",
    "FinalWindow",
    "LowEffort",
    "MinimumEffort",
    "NeverExceeds",
    "OracleTeacher",
    "Phase",
    "PhaseImprovement",
    "Return",
    "Rule",
    "ScriptedTeacher",
    "Smoothness",
    "Teacher",
    "TeacherView",
    "WorstWindow",
    "make_teacher",
    "teacher_names",
]
