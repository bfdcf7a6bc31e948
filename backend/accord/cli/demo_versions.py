"""How well each reward version of a demo predicts pairs that nobody labelled, and whether it uses attention."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from accord.cli.own_service import OwnService
from accord.services import publish
from accord.services.collect import load_arrays
from accord.store import segments
from accord.workers.model_store import read_reward_model
from mapt.benchmarks.evaluate import preference_metrics, random_pairs
from mapt.io import atomic_path
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.teachers import ScriptedTeacher, TeacherView
from mapt.rewards.attention_trial import GAIN, GAIN_ERROR, IN_USE
from mapt.rewards.inspection import predict

#: Limits of the fresh pairs; scoring 600 segments takes one to two seconds a version.
MAX_SEGMENTS, PAIRS = 600, 2000


@dataclass(frozen=True, slots=True)
class VersionReport:
    """One reward version of a run. Numbers that are unknown are NaN."""

    version: int
    labels: int
    #: environment steps of the policy when it was published
    steps: int
    #: fraction of the fresh pairs in which it prefers the segment with the better score by the teacher
    fresh_accuracy: float
    #: number of these pairs, without ties
    fresh_pairs: int
    holdout_accuracy: float
    #: 1 if its rewards depend on attention, else 0
    attention: float
    #: of the latest trial, in nats
    attention_gain: float
    attention_gain_error: float
    #: of its training
    seconds: float


def report_versions(
    service: OwnService, experiment_id: str, teacher: ScriptedTeacher, seed: int
) -> list[VersionReport]:
    """Evaluate every reward version of an experiment on fresh pairs, the same for all.

    Fresh pairs are drawn at random among the stored segments of the whole run that are in no query, at most
    `MAX_SEGMENTS` of them. The teacher judges them by its scores, without mistakes and skips.
    """
    with service.reading() as (session, blobs):
        rng = np.random.default_rng([seed, 4])
        keys = segments.blob_keys_without_query(session, experiment_id)
        if len(keys) < 2:
            return []
        chosen = sorted(rng.permutation(len(keys))[:MAX_SEGMENTS].tolist())
        arrays = [load_arrays(blobs, keys[index]) for index in chosen]
        inputs = SegmentArrays.stack([each["observations"] for each in arrays], [each["actions"] for each in arrays])
        pairs = random_pairs(np.arange(len(arrays)), PAIRS, rng)
        scores = teacher.scores(TeacherView.stack(arrays))
        better = (0.5 + 0.5 * np.sign(np.subtract(*scores[pairs].T))).astype(np.float32)
        reports: list[VersionReport] = []
        for row in publish.versions(session, experiment_id):
            predicted = predict(read_reward_model(blobs, row.blob_key), inputs).scores
            accuracy = preference_metrics(np.subtract(*predicted[pairs].T), better)["accuracy"]
            known = (row.metrics.get(name) for name in ("holdout_accuracy", IN_USE, GAIN, GAIN_ERROR, "seconds"))
            metrics = [math.nan if value is None else value for value in known]
            n_pairs = int((better != 0.5).sum())
            reports.append(VersionReport(row.number, row.label_count, row.policy_steps, accuracy, n_pairs, *metrics))
    return reports


def read_reports(path: Path) -> list[VersionReport]:
    """The reports in a file of `write_reports`."""
    with path.open(newline="") as file:
        return [VersionReport(**_numbers(line)) for line in csv.DictReader(file)]


def _numbers(line: Mapping[str, str]) -> dict[str, Any]:
    return {
        field.name: int(line[field.name]) if field.type is int else float(line[field.name] or "nan")
        for field in fields(VersionReport)
    }


def write_reports(reports: Sequence[VersionReport], path: Path) -> None:
    """Write a CSV file with one line per version; unknown numbers are empty."""
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow([field.name for field in fields(VersionReport)])
        lines.writerows([("" if math.isnan(value) else value) for value in astuple(each)] for each in reports)
