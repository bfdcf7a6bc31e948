"""What goes over the wire. The page's TypeScript client is generated from these."""

from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from accord.domain.words import ExperimentStatus, Phase, Role


class Schema(BaseModel):
    model_config = ConfigDict(extra="forbid", from_attributes=True)


# Sign-in


class Me(Schema):
    """The signed-in user."""

    id: str
    name: str
    role: Role


class NewUser(Schema):
    name: str = Field(min_length=1, max_length=100)
    role: Role


class CreatedUser(Schema):
    id: str
    name: str
    role: Role
    token: str = Field(description="Bearer token. Shown once: only its hash is kept.")
    sign_in_url: str = Field(description="Opens the page signed in as this user. Works once.")


# Experiments


class TaskSchema(Schema):
    name: str
    n_agents: int
    agent_names: list[str]
    agent_colours: list[str] = Field(description="CSS colours of the agents in the clips, in agent order.")
    observation_dim: int
    action_dim: int
    horizon_steps: int
    step_seconds: float
    instructions: str


class NewExperiment(Schema):
    """Settings of an experiment; what is left out has the default of `accord.domain.experiment`."""

    name: str = Field(min_length=1, max_length=200)
    task: str
    instructions: str | None = Field(default=None, description="What labellers are told; the task's own if left out.")
    total_steps: int = 1_000_000
    segment_steps: int = 50
    label_budget: int = 500
    initial_labels: int = 100
    labels_per_version: int = 50
    lookahead_queries: int = 8
    pacing: Literal["wait", "free"] = "wait"
    reward_source: Literal["preferences", "true"] = "preferences"
    reward_preset: str = "small"
    credit: Literal["shared", "individual"] = "shared"
    render_clips: bool = True
    policy: dict[str, int | float | bool | str] = Field(default_factory=dict[str, "int | float | bool | str"])
    device: str = "auto"
    seed: int = 0


class LabelCounts(Schema):
    budget: int
    labels: int = Field(description="Labels that count: 1, 0 or 0.5.")
    skips: int
    due: int = Field(description="Labels the schedule asks for by now.")
    open_queries: int = Field(description="Queries ready to be labelled.")
    rendering_queries: int = Field(description="Queries that wait for their clips.")


class Experiment(Schema):
    id: str
    name: str
    task: TaskSchema
    instructions: str
    config: dict[str, Any]
    status: ExperimentStatus
    phase: Phase
    phase_detail: str
    steps: int
    labels: LabelCounts
    reward_version: int | None = Field(description="Number of the newest reward version.")
    created_at: datetime
    ended_at: datetime | None


class ExperimentPage(Schema):
    items: list[Experiment]
    next_cursor: str | None = None


class MetricPoint(Schema):
    step: int
    value: float
    reward_version_id: str | None = None


class MetricSeries(Schema):
    name: str
    points: list[MetricPoint]


class Metrics(Schema):
    """Curves of an experiment by name. Series of true rewards are left out for labellers."""

    series: list[MetricSeries]


class RewardVersion(Schema):
    id: str
    number: int
    parent_id: str | None
    label_watermark: int
    label_count: int
    policy_steps: int
    metrics: dict[str, Any]
    created_at: datetime


class RewardVersionPage(Schema):
    items: list[RewardVersion]


class Worker(Schema):
    id: str
    role: str
    state: str
    detail: str
    restarts: int
    heartbeat_age_seconds: float


# Labelling


class SegmentView(Schema):
    """One side of a query."""

    index: Literal[0, 1] = Field(description="The segment's number within the query: label 1 prefers 0.")
    segment_id: str
    clip_url: str | None = Field(description="Path of the mp4; None when the experiment makes no clips.")
    seconds: float
    frames: int
    true_return: float | None = Field(default=None, description="For teachers and researchers that ask; else absent.")
    true_rewards: list[float] | None = Field(default=None, description="Per step; as true_return.")


class Query(Schema):
    id: str
    experiment_id: str
    number: int
    left: SegmentView
    right: SegmentView
    lease_seconds: float = Field(description="Send a heartbeat, or the label, before this is over.")


class Queries(Schema):
    items: list[Query]
    reason: Literal["", "rendering", "policy_training", "all_labelled", "experiment_over", "paused"] = Field(
        default="", description="Why there are fewer than asked for."
    )


class NewLabel(Schema):
    """The answer to a query. Posting the same again changes nothing."""

    label: float | None = Field(
        description="1, 0 or 0.5 (see `order`); null skips: it is stored, and never trained on."
    )
    order: Literal["segments", "shown"] = Field(
        default="segments",
        description="`segments`: 1 means that segment 0 is better. `shown`: 1 means that the left clip is better, "
        "and the server undoes the side that was drawn.",
    )
    response_seconds: float | None = Field(default=None, ge=0, le=86_400)
    teacher: dict[str, Any] = Field(
        default_factory=dict[str, Any], description="A scripted teacher's name and parameters."
    )


class Label(Schema):
    query_id: str
    label: float | None = Field(description="In segment order: 1 means that segment 0 is better; null is a skip.")
    state: Literal["label", "skip", "undone"]
    left_segment: int | None
    revision: int
    created: bool = Field(description="False when the same label was there already.")


class BatchLabel(NewLabel):
    query_id: str


class LabelBatch(Schema):
    labels: list[BatchLabel] = Field(min_length=1, max_length=1000)


class BatchOutcome(Schema):
    query_id: str
    ok: bool
    label: Label | None = None
    code: str | None = Field(default=None, description="Stable error code when not ok.")
    message: str | None = None


class LabelBatchResult(Schema):
    items: list[BatchOutcome]


class Lease(Schema):
    query_id: str
    lease_seconds: float


# Errors


class ErrorBody(Schema):
    code: str = Field(description="Stable; programs may rely on it.")
    message: str = Field(description="What was wrong and what to do.")
    details: list[dict[str, Any]] = Field(default_factory=list[dict[str, Any]])


class ErrorResponse(Schema):
    error: ErrorBody
