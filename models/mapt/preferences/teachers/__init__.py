"""Scripted teachers: they see what a person would, and more, and label by a rule.

`make_teacher("phase+mistake", seed=0, mistake=0.05).judge(first, second)` labels pairs of `Evidence`.
"""

from mapt.preferences.teachers.evidence import Evidence
from mapt.preferences.teachers.rules import (
    BestSecond,
    FindsPhase,
    Never,
    NobodyIdle,
    Phase,
    Recency,
    Return,
    Rule,
    SharedLoad,
    Smoothness,
    WorstSecond,
)
from mapt.preferences.teachers.scripted import (
    PRESETS,
    RULES,
    Habits,
    OracleTeacher,
    ScriptedTeacher,
    Teacher,
    make_teacher,
    teacher_names,
)

__all__ = [
    "PRESETS",
    "RULES",
    "BestSecond",
    "Evidence",
    "FindsPhase",
    "Habits",
    "Never",
    "NobodyIdle",
    "OracleTeacher",
    "Phase",
    "Recency",
    "Return",
    "Rule",
    "ScriptedTeacher",
    "SharedLoad",
    "Smoothness",
    "Teacher",
    "WorstSecond",
    "make_teacher",
    "teacher_names",
]
