"""Request and response bodies. The page's TypeScript client is generated from them."""

from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from accord.domain.enums import ExperimentStatus, Phase, QueryStatus, Role, WorkerRole, WorkerState
from accord.services.experiment_config import ExperimentConfig
from mapt.settings import json_schema


class Schema(BaseModel):
    model_config = ConfigDict(extra="forbid", from_attributes=True)


# Sign-in


class Me(Schema):
    """The signed-in user."""

    id: str = Field(description="usr_...")
    name: str = Field(description="Unique name.")
    role: Role = Field(description="What the user may do.")


class NewUser(Schema):
    """A user to create."""

    name: str = Field(min_length=1, max_length=100, description="Must be unique, and one line.")
    role: Role = Field(
        description="labeller: a person who labels. teacher: a program that labels and may read true returns. "
        "researcher: also runs experiments. admin: also adds users."
    )


class CreatedUser(Schema):
    """A new user and their token."""

    id: str = Field(description="usr_...")
    name: str = Field(description="The name, without surrounding spaces.")
    role: Role = Field(description="The role.")
    token: str = Field(description="Bearer token. Only its hash is stored, so it cannot be shown again.")
    sign_in_url: str = Field(description="Signs a browser in as this user. Works once.")


# Experiments


class TaskSchema(Schema):
    """A cooperative multi-agent task."""

    name: str = Field(description="For example HalfCheetah-6x1.")
    n_agents: int = Field(description="Agents in the team, N.")
    agent_names: list[str] = Field(description="Names of the agents, in agent order.")
    agent_colours: list[str] = Field(description="CSS colours of the agents in the clips, in agent order.")
    observation_dim: int = Field(description="Size of one agent's observation, C.")
    action_dim: int = Field(description="Size of one agent's action, A.")
    horizon_steps: int = Field(description="Longest episode, in steps.")
    step_seconds: float = Field(description="Simulated seconds per step.")
    instructions: str = Field(description="What the team should achieve.")


def _add_settings(schema: dict[str, Any]) -> None:
    """Adds every setting of an experiment to the schema of `NewExperiment`."""
    settings = json_schema(ExperimentConfig)
    schema["properties"] |= settings["properties"]
    schema["required"] += settings["required"]
    schema["additionalProperties"] = False


class NewExperiment(Schema):
    """An experiment to start. Every setting except the task has a default."""

    # The settings are validated by ExperimentConfig itself: read them with `settings`.
    model_config = ConfigDict(extra="allow", json_schema_extra=_add_settings)

    name: str = Field(min_length=1, max_length=200, description="Must be unique, and one line.")
    instructions: str | None = Field(
        default=None, max_length=4000, description="Shown to labellers; by default, those of the task."
    )

    @property
    def settings(self) -> dict[str, Any]:
        """Every field but the name and the instructions, not validated."""
        return self.model_extra or {}


class LabelCounts(Schema):
    """Progress of an experiment's labelling."""

    budget: int = Field(description="Labels to collect in total.")
    labels: int = Field(description="Labels 1, 0 or 0.5, without skips.")
    skips: int = Field(description="Skipped queries.")
    due: int = Field(description="Labels due at the policy's current step.")
    open_queries: int = Field(description="Queries ready to label.")
    rendering_queries: int = Field(description="Queries whose clips are not rendered yet.")


class EvaluatedReturn(Schema):
    """True return of whole episodes with mean actions."""

    mean: float = Field(description="Mean over the episodes.")
    std: float | None = Field(description="Standard deviation over the episodes.")
    min: float | None = Field(description="Lowest return of an episode.")
    max: float | None = Field(description="Highest return of an episode.")


class EvaluatedReturns(Schema):
    """True returns of the policy before and after training."""

    untrained: EvaluatedReturn | None = Field(description="Before the first update; null until it is measured.")
    final: EvaluatedReturn | None = Field(description="After the last update; null until it is measured.")


class Experiment(Schema):
    """An experiment with its current state."""

    id: str = Field(description="exp_...")
    name: str = Field(description="Unique name.")
    task: TaskSchema = Field(description="The task.")
    instructions: str = Field(description="Shown to labellers.")
    config: dict[str, Any] = Field(description="Every setting; they never change.")
    status: ExperimentStatus = Field(description="Whether it runs, and how it ended.")
    phase: Phase = Field(description="What the policy worker is doing.")
    phase_detail: str = Field(
        description="One sentence about the phase, or why it failed. Labellers get it only while the experiment waits."
    )
    waiting_for: Literal["", "policy_worker", "labels", "reward_version"] = Field(
        description="What the policy waits for; empty while it trains, and unless the experiment is running."
    )
    estimated_seconds: float | None = Field(
        description="Estimated seconds until the reward version is trained, or until the training policy needs more "
        "labels; null if unknown, or if there are labels to give."
    )
    steps: int = Field(description="Environment steps the policy has taken; the last rollout may exceed total_steps.")
    steps_per_second: float | None = Field(description="Speed of the policy's last iteration, without waiting.")
    labels: LabelCounts = Field(description="Progress of the labelling.")
    reward_version: int | None = Field(description="Number of the newest reward version.")
    returns: EvaluatedReturns | None = Field(description="For teachers, researchers and admins; null for labellers.")
    created_at: datetime = Field(description="When it was started.")
    ended_at: datetime | None = Field(description="When it finished, failed or was cancelled.")
    archived_at: datetime | None = Field(description="When it was archived; null if it is not.")


class ExperimentChanges(Schema):
    """What may be changed after an experiment is started."""

    instructions: str = Field(max_length=4000, description="Shown to labellers; if empty, those of the task.")


class Costs(Schema):
    """What an experiment has cost so far."""

    person_answers: int = Field(description="Labels and skips with a measured time, as people give them in the page.")
    people: int = Field(description="Number of people who gave them.")
    person_seconds: float = Field(description="Sum of the times from the start of both clips to the answer.")
    program_labels: int = Field(description="Labels that programs gave.")
    policy_seconds: float = Field(description="Collecting, relabelling and updating, without waiting and evaluations.")
    reward_seconds: float = Field(description="Training of the reward versions, without ensembles.")
    segments: int = Field(description="Stored segments.")
    clips: int = Field(description="Rendered clips.")
    clip_bytes: int = Field(description="Size of the clips.")


class Deletion(Schema):
    """The record of a deleted experiment."""

    id: str = Field(description="del_...")
    deleted_id: str = Field(description="Id of the experiment.")
    name: str = Field(description="Its name.")
    config: dict[str, Any] = Field(description="Its settings.")
    deleted_by: str = Field(description="Name of the user who deleted it.")
    rows: dict[str, int] = Field(description="Table to number of deleted rows, for example labels.")
    created_at: datetime = Field(description="When it was deleted.")


class ExperimentPage(Schema):
    """Some experiments, newest first."""

    items: list[Experiment] = Field(description="At most `limit`.")
    next_cursor: str | None = Field(
        default=None, description="Pass it as `cursor` to get the next page; null at the end."
    )


class MetricPoint(Schema):
    """One point of a curve."""

    step: int = Field(description="Environment steps of the policy.")
    value: float = Field(description="A finite number.")
    reward_version_id: str | None = Field(default=None, description="The reward version in use; null before the first.")


class MetricSeries(Schema):
    """One curve."""

    name: str = Field(description="For example learned_return.")
    points: list[MetricPoint] = Field(description="Sorted by step.")


class Metrics(Schema):
    """Curves of an experiment. Labellers get none that reveals true rewards."""

    series: list[MetricSeries] = Field(description="Sorted by name.")


class RewardVersion(Schema):
    """A version of the reward model. It never changes."""

    id: str = Field(description="rwv_...")
    number: int = Field(description="1, 2, 3, ... within the experiment.")
    parent_id: str | None = Field(description="The version before it.")
    label_watermark: int = Field(description="Label revision up to which it was trained.")
    label_count: int = Field(description="Number of labels it was trained on.")
    policy_steps: int = Field(description="Environment steps of the policy when it was published.")
    metrics: dict[str, Any] = Field(
        description=(
            "Loss, accuracy and so on, on training and held-out labels. attention is 1 if rewards depend on MAPT's "
            "attention, else 0; attention_gain is the reduction of the held-out loss by attention, in nats, with its "
            "standard error attention_gain_error over attention_gain_pairs pairs, at the latest trial; "
            "attention_trial_seconds is the time that this version spent on a trial."
        )
    )
    created_at: datetime = Field(description="When it was published.")


class RewardVersionPage(Schema):
    """Reward versions of an experiment."""

    items: list[RewardVersion] = Field(description="Oldest first.")


class Worker(Schema):
    """A worker process."""

    id: str = Field(description="Role and slot, for example policy-0.")
    role: WorkerRole = Field(description="What it does.")
    state: WorkerState = Field(
        description="waiting: its experiment waits for labels or for a reward version. backing_off: its work failed, "
        "and it retries after a pause. restarting: its process ended, and another one is being started."
    )
    detail: str = Field(description="What it is doing, or its last error; empty for labellers.")
    restarts: int = Field(description="Number of restarts.")
    heartbeat_age_seconds: float = Field(description="Seconds since its last heartbeat.")


class Health(Schema):
    """The service is healthy."""

    status: Literal["ok"] = Field(description="Always ok; a service that is not healthy returns an error.")


# Labelling


class SegmentView(Schema):
    """One side of a query."""

    index: Literal[0, 1] = Field(description="The segment's number within the query: label 1 prefers 0.")
    segment_id: str = Field(description="seg_...")
    clip_url: str | None = Field(description="Path of the MP4 file; null if the experiment renders no clips.")
    thumbnail_url: str | None = Field(description="Path of a still image of the clip; null if there is no clip.")
    seconds: float = Field(description="Duration of the clip.")
    frames: int = Field(description="Frames of the clip, one per step.")
    true_return: float | None = Field(
        default=None, description="With `returns=true`, for teachers, researchers and admins; otherwise null."
    )
    true_rewards: list[float] | None = Field(default=None, description="Per step; as `true_return`.")


class Query(Schema):
    """Two segments to compare, on the sides chosen for this user."""

    id: str = Field(description="qry_...")
    experiment_id: str = Field(description="exp_...")
    number: int = Field(description="1, 2, 3, ... within the experiment.")
    left: SegmentView = Field(description="What to show on the left.")
    right: SegmentView = Field(description="What to show on the right.")
    lease_seconds: float = Field(
        description="The lease expires after this many seconds without a heartbeat or a label."
    )


class Queries(Schema):
    """Queries leased to the caller."""

    items: list[Query] = Field(description="Sorted by number.")
    reason: Literal["", "rendering", "policy_training", "all_labelled", "experiment_over", "paused"] = Field(
        default="", description="Why there are fewer than requested."
    )


class NewLabel(Schema):
    """A label for a query. Sending the same label again changes nothing."""

    label: float | None = Field(
        strict=True, description="1, 0 or 0.5 (see `order`); null skips the query. Skips are stored but not trained on."
    )
    order: Literal["segments", "shown"] = Field(
        default="segments",
        description="segments: 1 means that segment 0 is better. shown: 1 means that the left clip is better; the "
        "server converts it to segment order.",
    )
    response_seconds: float | None = Field(
        default=None, ge=0, le=86_400, description="Seconds from the start of both clips to the label."
    )
    teacher: dict[str, Any] = Field(
        default_factory=dict[str, Any], description="A scripted teacher's name and parameters."
    )
    replaces: int | None = Field(
        default=None,
        ge=0,
        description="Revision of your label that this one replaces; 0 if you have not labelled the query. If it has "
        "another one, the response is 409 label_changed. Without it, any label is replaced.",
    )


class Label(Schema):
    """The caller's label on a query, as stored."""

    query_id: str = Field(description="qry_...")
    label: float | None = Field(description="In segment order: 1 means that segment 0 is better; null is a skip.")
    state: Literal["label", "skip", "undone"] = Field(description="Skips are stored but not trained on.")
    left_segment: int | None = Field(description="The segment shown on the left; null for a program.")
    revision: int = Field(
        description="Label revision of the experiment: one more with every label written, changed or undone."
    )
    created: bool = Field(description="False if the same label was already stored.")


class OwnLabel(Schema):
    """A label or skip of the caller, with the query on the sides that the caller saw."""

    query: Query = Field(description="The query. The caller does not hold it.")
    label: float | None = Field(description="In segment order: 1 means that segment 0 is better; null is a skip.")
    state: Literal["label", "skip"] = Field(description="Undone labels are not listed.")
    revision: int = Field(description="Pass it as `replaces` to change or undo the label.")
    response_seconds: float | None = Field(description="Seconds from the start of both clips to the label.")
    updated_at: datetime = Field(description="When it was given or last changed.")


class OwnLabels(Schema):
    """The caller's labels and skips in one experiment."""

    items: list[OwnLabel] = Field(description="Newest first.")
    labels: int = Field(description="How many labels the caller has given, without skips.")
    skips: int = Field(description="How many queries the caller has skipped.")
    next_before: int | None = Field(description="Pass it as `before` to get older ones; null at the end.")


class LabelRevision(Schema):
    """One entry of a label's history."""

    revision: int = Field(description="Label revision of the experiment.")
    label: float | None = Field(description="In segment order; null for a skip and for an undone label.")
    state: Literal["label", "skip", "undone"] = Field(description="What the labeller did.")
    left_segment: int | None = Field(description="The segment shown on the left; null for a program.")
    response_seconds: float | None = Field(description="Seconds from the start of both clips to the label.")
    created_at: datetime = Field(description="When it was given.")


class RecordedLabel(Schema):
    """A label with its author and history."""

    id: str = Field(description="lbl_...")
    user_id: str = Field(description="usr_...")
    user_name: str = Field(description="Who gave it.")
    role: Role = Field(description="The author's role.")
    teacher: dict[str, Any] = Field(description="A scripted teacher's name and parameters.")
    revisions: list[LabelRevision] = Field(description="Oldest first; the last one is the current label.")


class RecordedSegment(Schema):
    """A segment of a query."""

    segment_id: str = Field(description="seg_...")
    policy_steps: int = Field(description="Environment steps of the policy that produced it.")
    true_return: float = Field(description="Sum of its true rewards.")
    clip_url: str | None = Field(description="Path of the MP4 file; null if there is none (yet).")
    thumbnail_url: str | None = Field(description="Path of a still image; null if there is no clip.")


class RecordedQuery(Schema):
    """A query with all of its labels."""

    id: str = Field(description="qry_...")
    number: int = Field(description="1, 2, 3, ... within the experiment.")
    status: QueryStatus = Field(description="Whether it can be labelled.")
    selector: str = Field(description="Name of the query selector that chose it.")
    created_at: datetime = Field(description="When it was created.")
    segments: list[RecordedSegment] = Field(description="Segments 0 and 1.")
    labels: list[RecordedLabel] = Field(description="In the order in which they were first given.")


class LabelAuthor(Schema):
    """A user who has labelled an experiment."""

    id: str = Field(description="usr_...")
    name: str = Field(description="Unique name.")
    labels: int = Field(description="Labels in the experiment, without skips.")


class QueryPage(Schema):
    """Some queries of an experiment with their labels."""

    items: list[RecordedQuery] = Field(description="Newest first.")
    authors: list[LabelAuthor] = Field(description="Everyone who has labelled the experiment, by name.")
    next_before: int | None = Field(description="Pass it as `before` to get older ones; null at the end.")


class BatchLabel(NewLabel):
    """One label of a batch."""

    query_id: str = Field(description="qry_...")


class LabelBatch(Schema):
    """Labels to write in one transaction."""

    labels: list[BatchLabel] = Field(
        min_length=1, max_length=1000, description="Each is accepted or rejected on its own."
    )


class BatchOutcome(Schema):
    """Result for one label of a batch."""

    query_id: str = Field(description="The query of the label.")
    ok: bool = Field(description="Whether the label is stored.")
    label: Label | None = Field(default=None, description="The stored label, if ok.")
    code: str | None = Field(default=None, description="Stable error code, if not ok.")
    message: str | None = Field(default=None, description="What is wrong and what to do, if not ok.")


class LabelBatchResult(Schema):
    """Results of a batch, in the order of the labels."""

    items: list[BatchOutcome] = Field(description="One per label.")


class Lease(Schema):
    """A renewed lease."""

    query_id: str = Field(description="qry_...")
    lease_seconds: float = Field(description="The lease expires after this many seconds without another heartbeat.")


# Errors


class ErrorBody(Schema):
    """Description of an error."""

    code: str = Field(description="Stable; programs may rely on it.")
    message: str = Field(description="What is wrong and what to do.")
    details: list[dict[str, Any]] = Field(
        default_factory=list[dict[str, Any]],
        description="For an invalid value: `field`, for example policy.n_envs, and `problem`.",
    )


class ErrorResponse(Schema):
    """The body of every error response."""

    error: ErrorBody = Field(description="Description of the error.")
