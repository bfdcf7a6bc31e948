"""Experiments with segments, clips and queries, created through the services that the workers use."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from sqlalchemy.orm import Session

from accord.domain.enums import Role
from accord.services import accounts, clips, collect, experiments, select
from accord.services.experiment_config import ExperimentConfig
from accord.store.blobs import BlobStore
from accord.store.database import Database
from accord.store.tables import ExperimentRow, UserRow

#: T, N, C, A, nq and nv of the segments; tests depend on T only
STEPS, AGENTS, OBSERVATION, ACTION, NQ, NV = 5, 6, 9, 1, 9, 9
#: stand-in for an H.264 file
CLIP_BYTES = bytes(range(256)) * 8


def config(**changes: object) -> ExperimentConfig:
    """Settings of a small experiment."""
    settings: dict[str, object] = {
        "task": "HalfCheetah-6x1",
        "total_steps": 10_000,
        "segment_steps": STEPS,
        "label_budget": 20,
        "initial_labels": 10,
        "labels_per_version": 5,
        "lookahead_queries": 4,
    }
    return ExperimentConfig(**(settings | changes))  # type: ignore[arg-type]


def segment(reward: float = 0.0, policy_steps: int = 0) -> collect.NewSegment:
    """A segment with the same true reward at every step."""
    return collect.NewSegment(
        observations=np.zeros((STEPS, AGENTS, OBSERVATION)),
        actions=np.zeros((STEPS, AGENTS, ACTION)),
        rewards=np.full(STEPS, reward),
        qpos=np.zeros((STEPS, NQ)),
        qvel=np.zeros((STEPS, NV)),
        policy_iteration=policy_steps // 1000,
        policy_steps=policy_steps,
    )


def user(session: Session, name: str, role: Role = Role.LABELLER) -> tuple[UserRow, str]:
    return accounts.create_user(session, name, role)


@dataclass(frozen=True, slots=True)
class SampleExperiment:
    """An experiment with segments and queries."""

    experiment: ExperimentRow
    owner: UserRow
    #: bearer token of the owner, a researcher
    owner_token: str
    segment_ids: list[str]
    query_ids: list[str]


def create_sample(
    database: Database, blobs: BlobStore, *, segments: int = 5, queries: int = 4, ready: bool = True, **changes: object
) -> SampleExperiment:
    """Create an experiment with segments and queries. With `ready`, all clips exist; else they are pending.

    Segment i has the true reward i at each step.
    """
    with database.transaction() as session:
        owner, token = user(
            session, f"researcher {len(experiments.list_page(session, 100, None).rows)}", Role.RESEARCHER
        )
        name = f"experiment of {owner.name}"
        row = experiments.create(session, owner.id, name, config(**changes), None)
    stored = [collect.store_arrays(blobs, row.id, segment(float(i), 100 * i)) for i in range(segments)]
    ids = [each.id for each in stored]
    with database.transaction() as session:
        collect.collect(session, row.id, stored)
    with database.transaction() as session:
        row = experiments.get(session, row.id)
        pairs = list(combinations(ids, 2))[:queries]
        assert len(pairs) == queries, "too few segments for so many queries"
        query_ids = select.add_queries(session, row, pairs, "uniform")
    if ready:
        make_clips(database, blobs)
    return SampleExperiment(row, owner, token, ids, query_ids)


def make_clips(database: Database, blobs: BlobStore, holder: str = "tests") -> int:
    """Finish every pending clip without rendering, and return their number."""
    count = 0
    while True:
        with database.transaction() as session:
            job = clips.claim_pending(session, holder, 60.0)
        if job is None:
            return count
        key = f"clips/{job.clip_id}.mp4"
        blobs.put(key, CLIP_BYTES)
        with database.transaction() as session:
            clips.finish(session, job.clip_id, clips.StoredClip("0" * 64, key, len(CLIP_BYTES), STEPS, 0.25, 320, 240))
        count += 1
