"""Import of an export: a new experiment begins with the labels of another one, so that nobody gives them again."""

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from sqlalchemy.orm import Session

from accord.domain.enums import ExperimentStatus, QueryStatus, Role
from accord.domain.errors import Invalid
from accord.domain.ids import new_id
from accord.domain.label_values import LABEL_VALUES
from accord.services import accounts, experiments
from accord.services.collect import NewSegment, StoredSegment, collect, store_arrays
from accord.services.exclusion import recount
from accord.services.experiment_config import ExperimentConfig, read_config
from accord.store.blobs import BlobStore
from accord.store.tables import ClipRow, LabelRevisionRow, LabelRow, QueryRow, utc_now
from mapt.preferences.formats import tables as exported
from mapt.preferences.formats.records import SegmentRecords
from mapt.preferences.formats.tables import PreferenceTables
from mapt.tasks import task_spec

#: Iteration and steps of the policy that produced imported segments: they are older than all of the new experiment's.
BEFORE_THE_RUN = -1


@dataclass(frozen=True, slots=True)
class Imported:
    """The content of an export."""

    experiment_id: str
    config: ExperimentConfig
    #: every revision of what labellers read, oldest first
    instructions: list[str]
    #: id in the export -> segment
    segments: dict[str, StoredSegment]
    queries: list[exported.QueryRow]
    labels: list[exported.LabelRow]


@contextmanager
def storing(
    blobs: BlobStore, tables: PreferenceTables, on_segments: Callable[[int], None] = lambda _count: None
) -> Generator[Imported]:
    """Checks an export and stores its arrays, for a transaction in the block that calls `create`.

    If the export is damaged or the block fails, the arrays are deleted again.

    Args:
        on_segments: called with the number of segments stored so far.

    Raises:
        Invalid: if it is not the export of an experiment, is incomplete, or has no labels.
        InvalidExperiment: if this version of Accord cannot run its settings.
        PreferenceError: if a table is damaged.
        BlobsNotWritable: if the blobs are read-only or full.
    """
    found = _checked(tables)
    try:
        for rows, records in tables.segments():
            for row, segment in zip(rows, _segments(records), strict=True):
                stored = store_arrays(blobs, found.experiment_id, segment)
                found.segments[row.segment_id] = replace(
                    stored, mujoco_version=row.mujoco_version or stored.mujoco_version
                )
            on_segments(len(found.segments))
        yield found
    except BaseException:
        for segment in found.segments.values():
            blobs.delete(segment.blob_key)
        raise


def _checked(tables: PreferenceTables) -> Imported:
    """The content of an export whose rows are complete, without its segments. Raises as `storing`."""
    about = tables.about
    if not isinstance(about.get("config"), Mapping):
        raise Invalid("The export does not hold an experiment of Accord: its metadata has no settings.")
    # Settings of other versions: those that are missing take today's defaults, and all are validated.
    config = read_config(ExperimentConfig.from_stored(about["config"]).to_dict())
    labels = sorted(tables.labels(), key=lambda label: (label.revision or 0, label.query_id))
    labelled = {label.query_id for label in labels if label.state == "label"}
    every = tables.queries()
    unknown = {label.query_id for label in labels} - {query.query_id for query in every}
    if unknown:
        raise Invalid(f"The export is incomplete: its labels refer to {len(unknown)} queries that it does not hold.")
    # Researchers chose the pairs with a known answer: they are kept without labels too.
    queries = [query for query in every if query.query_id in labelled or query.gold is not None]
    if not labelled:
        raise Invalid("The export holds no labels to import.")
    segment_ids = Counter(tables.segment_ids())
    twice = [id for id, count in segment_ids.items() if count > 1]
    if twice:
        raise Invalid(f"The export is damaged: it holds {len(twice)} segments twice, for example {twice[0]}.")
    missing = {each for query in queries for each in (query.segment_0_id, query.segment_1_id)} - segment_ids.keys()
    if missing:
        raise Invalid(f"The export is incomplete: its queries refer to {len(missing)} segments that it does not hold.")
    kept = [label for label in labels if label.query_id in labelled]
    for label in kept:
        if label.label is not None and label.label not in LABEL_VALUES[config.answer_scale]:
            raise Invalid(
                f"The export is damaged: it holds a label of {label.label}, which the answer scale "
                f"{config.answer_scale!r} of its experiment does not have."
            )
    agents = range(tables.layout.n_agents)
    if any(label.decisive_agent is not None and label.decisive_agent not in agents for label in kept):
        raise Invalid("The export is damaged: a label names an agent that its task does not have.")
    return Imported(new_id("exp"), config, _instructions(about), {}, queries, kept)


def create(  # noqa: PLR0917 (as `experiments.create`)
    session: Session,
    owner_id: str,
    name: str,
    found: Imported,
    memory_limit_bytes: int = 0,
    creation_key: str | None = None,
) -> None:
    """Creates the experiment, paused, with the imported segments, queries and labels.

    Queries without a label are left out unless their answer is known. The labels of teachers who are users of this
    installation stay theirs; every other teacher becomes a new user who cannot sign in. Render workers make the clips
    from the simulator states, after those that a query waits for; an export of a task that renders itself has no
    states, and its pairs get no clips.

    Raises:
        UnknownTask, InvalidExperiment, NameTaken, Invalid: as `experiments.create`.
    """
    row = experiments.create(
        session,
        owner_id,
        name,
        found.config,
        found.instructions[0],
        experiment_id=found.experiment_id,
        memory_limit_bytes=memory_limit_bytes,
        creation_key=creation_key,
    )
    for text in found.instructions[1:]:
        experiments.edit_instructions(session, row.id, text)
    row.status = ExperimentStatus.PAUSED.value
    collect(session, row.id, list(found.segments.values()))
    query_ids: dict[str, str] = {}
    for number, query in enumerate(found.queries, 1):
        query_ids[query.query_id] = new_id("qry")
        session.add(
            QueryRow(
                id=query_ids[query.query_id],
                experiment_id=row.id,
                segment_0_id=found.segments[query.segment_0_id].id,
                segment_1_id=found.segments[query.segment_1_id].id,
                number=number,
                status=QueryStatus.CLOSED.value,
                selector=query.selector or "imported",
                # It stays a repeat where the query that it repeats has no label left and is not imported.
                repeats_id=None if query.repeats_id is None else query_ids.get(query.repeats_id, ""),
                gold_value=query.gold,
                practice=query.gold is not None and bool(query.practice),
                explanation=query.explanation or "",
            )
        )
    session.flush()
    if found.config.render_clips and task_spec(found.config.task).nq > 0:
        shown = {each for query in found.queries for each in (query.segment_0_id, query.segment_1_id)}
        session.add_all(
            ClipRow(id=new_id("clp"), experiment_id=row.id, segment_id=found.segments[each].id)
            for each in sorted(shown)
        )
    users = _users(session, row.name, found.labels)
    revisions = range(1, row.instructions_revision + 1)
    for revision, label in enumerate(found.labels, 1):
        given_at = label.labelled_at or utc_now()
        # what the label and its first revision have in common
        answer: dict[str, Any] = {
            "experiment_id": row.id,
            "revision": revision,
            "value": label.label,
            "state": label.state,
            "left_segment": label.left_segment,
            "response_seconds": label.response_seconds,
            "decisive_agent": label.decisive_agent,
            "instructions_revision": label.instructions_revision if label.instructions_revision in revisions else None,
            "created_at": given_at,
        }
        label_row = LabelRow(
            id=new_id("lbl"),
            query_id=query_ids[label.query_id],
            user_id=users[label.teacher_id],
            teacher=dict(label.teacher),
            updated_at=given_at,
            excluded=bool(label.excluded),
            final=bool(label.final),
            **answer,
        )
        session.add(label_row)
        session.flush()
        session.add(LabelRevisionRow(label_id=label_row.id, **answer))
    row.label_revision = len(found.labels)
    session.flush()
    recount(session, row.id)


def _instructions(about: Mapping[str, Any]) -> list[str]:
    """Every revision of the instructions, oldest first; only the newest one of an earlier version of Accord."""
    revisions = about.get("instruction_revisions")
    if revisions:
        try:
            return [str(each["text"]) for each in cast(list[dict[str, Any]], revisions)]
        except (TypeError, KeyError) as error:
            raise Invalid("The metadata of the export has damaged revisions of the instructions.") from error
    return [str(about.get("instructions", ""))]


def _segments(records: SegmentRecords) -> Iterator[NewSegment]:
    """Raises Invalid if there are no true rewards, which every experiment stores."""
    if records.rewards is None:
        raise Invalid("The segments of the export have no true rewards.")
    for index, length in enumerate(records.lengths):
        # A task without MuJoCo states has none.
        states = [
            np.zeros((length, 0)) if each is None else each[index, :length] for each in (records.qpos, records.qvel)
        ]
        yield NewSegment(
            observations=records.segments.observations[index, :length],
            actions=records.segments.actions[index, :length],
            rewards=records.rewards[index, :length],
            qpos=states[0],
            qvel=states[1],
            policy_iteration=BEFORE_THE_RUN,
            policy_steps=BEFORE_THE_RUN,
        )


def _users(session: Session, experiment_name: str, labels: list[exported.LabelRow]) -> dict[str, str]:
    """Id of a teacher in the export -> id of a user."""
    ids: dict[str, str] = {}
    for teacher_id in dict.fromkeys(label.teacher_id for label in labels):
        known = accounts.user_by_id(session, teacher_id)
        if known is None:
            name = f"{experiment_name[:60]}, imported {len(ids) + 1} {new_id('usr')[-6:]}"
            known, _token = accounts.create_user(session, name, Role.LABELLER)
        ids[teacher_id] = known.id
    return ids
