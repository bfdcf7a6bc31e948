"""How a scripted teacher scores the segments of a policy, which is what a policy learns from its labels."""

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mapt.errors import DamagedRun
from mapt.io import atomic_write
from mapt.policies import Policy
from mapt.policies.episodes import actor
from mapt.preferences.segments import cut_rollout
from mapt.preferences.teachers import ScriptedTeacher, TeacherView
from mapt.preferences.teachers.view import Float64s
from mapt.tasks import Task, make_task, task_spec
from mapt.training.evaluation import EPISODES, SEED_OF_STARTS
from mapt.training.run_folder import RunFolder


@dataclass(frozen=True, slots=True)
class TeacherScores:
    """Scores of segments of the untrained and of the final policy of a run, by one teacher."""

    #: environment steps of the final policy
    steps: int
    #: T of the segments
    segment_steps: int
    #: (S,) each
    untrained: Float64s
    final: Float64s


def preference_rate(scores: Float64s, others: Float64s) -> float:
    """The fraction of pairs in which a teacher without error prefers the first segment; ties count as half.

    Args:
        scores: of the segments of one policy, (S,).
        others: of those of another policy, (S',). All S x S' pairs count.
    """
    ordered = np.sort(others)
    below, not_above = (np.searchsorted(ordered, scores, side) for side in ("left", "right"))
    return float((below + not_above).mean() / (2 * len(others)))


def score_policy(
    policy: Policy,
    task_name: str,
    teacher: ScriptedTeacher,
    *,
    agent_obsk: int,
    segment_steps: int,
    episodes: int = EPISODES,
    deterministic: bool = True,
    seed: int = 0,
) -> Float64s:
    """Scores (S,) of the segments of whole episodes, without the teacher's mistakes and skips.

    S is 0 if every episode terminates before a segment fits. The episodes are those of `evaluate_policy` with the same
    arguments, if it plays all of them in parallel.

    Args:
        segment_steps: T. Segments do not overlap; see `cut_rollout`.
        deterministic: with the mean or the most likely actions instead of sampled ones.
        seed: of the initial states, of sampled actions and of the segments' offsets.

    Raises:
        InvalidTeacher: if the teacher cannot judge this task.
        MissingArray: if the observations lack what the teacher judges by.
    """
    teacher.check_task(task_name, discrete_actions=task_spec(task_name).discrete_actions)
    task = make_task(task_name, episodes, agent_obsk=agent_obsk)
    try:
        segments = _segments(policy, task, segment_steps, seed + SEED_OF_STARTS, deterministic=deterministic)
    finally:
        task.close()
    return teacher.scores(TeacherView.stack(segments)) if segments else np.zeros(0)


def _segments(
    policy: Policy, task: Task, segment_steps: int, seed: int, *, deterministic: bool
) -> list[dict[str, np.ndarray]]:
    """The segments of one episode of each environment."""
    steps: dict[str, list[np.ndarray]] = {name: [] for name in ("observations", "actions", "rewards", "qpos", "qvel")}
    terminated: list[np.ndarray] = []
    lengths = np.zeros(task.n_envs, dtype=np.int64)
    playing = np.ones(task.n_envs, dtype=bool)
    starts = [playing]
    act = actor(policy, task, deterministic=deterministic, seed=seed)
    observations, _ = task.reset(seed)
    while playing.any():
        qpos, qvel = task.simulator_state()
        actions = act(observations)
        step = task.step(actions)
        for name, array in zip(steps, (observations, actions, step.reward, qpos, qvel), strict=True):
            steps[name].append(array)
        lengths += playing
        ended = step.terminated | step.truncated
        playing = playing & ~ended
        terminated.append(step.terminated)
        starts.append(ended)
        observations = step.observations
    arrays = {name: np.stack(parts) for name, parts in steps.items()}
    places = cut_rollout(np.stack(starts[:-1]), np.stack(terminated), segment_steps, np.random.default_rng(seed))
    return [
        {name: array[place.first : place.end, place.env] for name, array in arrays.items()}
        for place in places
        if place.end <= lengths[place.env]
    ]


def write_teacher_scores(folder: RunFolder, teacher: str, scores: TeacherScores) -> None:
    """Add the scores by one teacher to a run folder, or replace them.

    Args:
        teacher: name and parameters; scores by others are kept.
    """
    known = {name: _to_dict(each) for name, each in read_teacher_scores(folder).items()}
    content = json.dumps({**known, teacher: _to_dict(scores)}, indent=2)
    atomic_write(folder.teacher_scores, content.encode() + b"\n")


def read_teacher_scores(folder: RunFolder) -> dict[str, TeacherScores]:
    """Scores by the names of the teachers.

    Raises:
        DamagedRun: if the file is damaged.
    """
    if not folder.teacher_scores.exists():
        return {}
    try:
        stored = json.loads(folder.teacher_scores.read_bytes())
        return {teacher: _from_dict(values) for teacher, values in stored.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DamagedRun(folder.teacher_scores, str(error)) from error


def _to_dict(scores: TeacherScores) -> dict[str, object]:
    return {
        "steps": scores.steps,
        "segment_steps": scores.segment_steps,
        "untrained": scores.untrained.tolist(),
        "final": scores.final.tolist(),
    }


def _from_dict(values: Mapping[str, object]) -> TeacherScores:
    untrained, final = (np.asarray(values[name], dtype=np.float64) for name in ("untrained", "final"))
    return TeacherScores(int(str(values["steps"])), int(str(values["segment_steps"])), untrained, final)
