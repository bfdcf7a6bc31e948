"""Scripted teachers: they see what a person would, and more, and label by a rule.

`make_teacher("phase+mistake", seed=0, mistake=0.05).judge(first, second)` labels pairs of `Evidence`.
"""

from mapt.preferences.teachers.cooperation import FindsPhase, NobodyIdle, Phase, SharedLoad
from mapt.preferences.teachers.evidence import Evidence
from mapt.preferences.teachers.history import BestSecond, Never, Recency, Return, Smoothness, WorstSecond
from mapt.preferences.teachers.protocol import Teacher
from mapt.preferences.teachers.registry import PRESETS, RULES, make_teacher, teacher_names
from mapt.preferences.teachers.rule import Rule
from mapt.preferences.teachers.scripted import Habits, OracleTeacher, ScriptedTeacher

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
