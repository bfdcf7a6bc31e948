"""What goes over the wire. The page's TypeScript client is generated from these."""

from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from accord.domain.enums import ExperimentStatus, Phase, Role
from accord.services.experiment_config import ExperimentConfig
from mapt.settings import json_schema


class Schema(BaseModel):
    model_config = ConfigDict(extra="forbid", from_attributes=True)


# Sign-in


class Me(Schema):
    """The signed-in user."""

    id: str = Field(description="usr_...")
    name: str = Field(description="Shown to others.")
    role: Role = Field(description="What the user may do.")


class NewUser(Schema):
    """A user to add."""

    name: str = Field(min_length=1, max_length=100, description="One line; no two users have the same.")
    role: Role = Field(
        description="labeller: a person who labels. teacher: a program that labels and may read true returns. "
        "researcher: runs experiments. admin: adds users too."
    )


class CreatedUser(Schema):
    """A new user, with the only copy of their token."""

    id: str = Field(description="usr_...")
    name: str = Field(description="As given, without spaces around it.")
    role: Role = Field(description="As given.")
    token: str = Field(description="Bearer token. Shown once: only its hash is kept.")
    sign_in_url: str = Field(description="Opens the page signed in as this user. Works once.")


# Experiments


class TaskSchema(Schema):
    """A task that a team of agents can be taught."""

    name: str = Field(description="For example HalfCheetah-6x1.")
    n_agents: int = Field(description="Agents in the team, N.")
    agent_names: list[str] = Field(description="What the agents are called, in agent order.")
    agent_colours: list[str] = Field(description="CSS colours of the agents in the clips, in agent order.")
    observation_dim: int = Field(description="Numbers in one agent's observation, C.")
    action_dim: int = Field(description="Numbers in one agent's action, A.")
    horizon_steps: int = Field(description="Steps after which an episode is cut.")
    step_seconds: float = Field(description="Simulated time of one step.")
    instructions: str = Field(description="What the team should achieve, in plain words.")


def _add_settings(schema: dict[str, Any]) -> None:
    """Adds every setting of an experiment to the schema of `NewExperiment`."""
    settings = json_schema(ExperimentConfig)
    schema["properties"] |= settings["properties"]
    schema["required"] += settings["required"]
    schema["additionalProperties"] = False


class NewExperiment(Schema):
    """An experiment to start; every setting but the task has a default."""

    # The settings are validated by ExperimentConfig itself: read them with `settings`.
    model_config = ConfigDict(extra="allow", json_schema_extra=_add_settings)

    name: str = Field(min_length=1, max_length=200, description="Must be unique, and one line.")
    instructions: str | None = Field(
        default=None, max_length=4000, description="Shown to labellers; the task's own if left out."
    )

    @property
    def settings(self) -> dict[str, Any]:
        """Every field but the name and the instructions, not validated."""
        return self.model_extra or {}


class LabelCounts(Schema):
    """How far the labelling of an experiment is."""

    budget: int = Field(description="Labels asked for in all.")
    labels: int = Field(description="Labels that count: 1, 0 or 0.5.")
    skips: int = Field(description="Times that somebody could not tell.")
    due: int = Field(description="Labels the schedule asks for by now.")
    open_queries: int = Field(description="Queries ready to be labelled.")
    rendering_queries: int = Field(description="Queries that wait for their clips.")


class Experiment(Schema):
    """An experiment as it is now."""

    id: str = Field(description="exp_...")
    name: str = Field(description="As it was given.")
    task: TaskSchema = Field(description="What is taught.")
    instructions: str = Field(description="What labellers are told.")
    config: dict[str, Any] = Field(description="Every setting, as when the experiment was started.")
    status: ExperimentStatus = Field(description="What its owner wants of it, and how it ended.")
    phase: Phase = Field(description="What its policy worker is doing.")
    phase_detail: str = Field(description="A sentence beside the phase, or why it failed; empty for labellers.")
    steps: int = Field(description="Environment steps the policy has taken.")
    labels: LabelCounts = Field(description="How far the labelling is.")
    reward_version: int | None = Field(description="Number of the newest reward version.")
    created_at: datetime = Field(description="When it was started.")
    ended_at: datetime | None = Field(description="When it finished, failed or was cancelled.")


class ExperimentPage(Schema):
    """Some experiments, newest first."""

    items: list[Experiment] = Field(description="At most `limit`.")
    next_cursor: str | None = Field(default=None, description="Give it as `cursor` for the next page; null at the end.")


class MetricPoint(Schema):
    """One point of a curve."""

    step: int = Field(description="Environment steps of the policy.")
    value: float = Field(description="Always finite.")
    reward_version_id: str | None = Field(default=None, description="The reward version in force; null before any.")


class MetricSeries(Schema):
    """One curve."""

    name: str = Field(description="For example learned_return.")
    points: list[MetricPoint] = Field(description="By step.")


class Metrics(Schema):
    """Curves of an experiment by name. Series of true rewards are left out for labellers."""

    series: list[MetricSeries] = Field(description="By name.")


class RewardVersion(Schema):
    """A trained reward model. It never changes: the next one is another version."""

    id: str = Field(description="rwv_...")
    number: int = Field(description="1, 2, 3, ... within the experiment.")
    parent_id: str | None = Field(description="The version it was trained on from.")
    label_watermark: int = Field(description="It knows every label with a revision up to this one.")
    label_count: int = Field(description="Labels it was trained on.")
    policy_steps: int = Field(description="Environment steps of the policy when it was published.")
    metrics: dict[str, Any] = Field(description="Loss, accuracy and so on, on training and held-out labels.")
    created_at: datetime = Field(description="When it was published.")


class RewardVersionPage(Schema):
    """Reward versions of an experiment."""

    items: list[RewardVersion] = Field(description="Oldest first.")


class Worker(Schema):
    """A worker process."""

    id: str = Field(description="Role and slot, for example policy-0.")
    role: str = Field(description="render, reward or policy.")
    state: str = Field(description="starting, idle, working, backing_off or stopped.")
    detail: str = Field(description="What it does, or what went wrong; empty for labellers.")
    restarts: int = Field(description="How often it was started again.")
    heartbeat_age_seconds: float = Field(description="Since its last sign of life.")


class Health(Schema):
    """The service can do its work."""

    status: Literal["ok"] = Field(description="Anything else is an error with a sentence.")


# Labelling


class SegmentView(Schema):
    """One side of a query."""

    index: Literal[0, 1] = Field(description="The segment's number within the query: label 1 prefers 0.")
    segment_id: str = Field(description="seg_...")
    clip_url: str | None = Field(description="Path of the mp4; None when the experiment makes no clips.")
    seconds: float = Field(description="How long the clip lasts.")
    frames: int = Field(description="Frames of the clip, one per step.")
    true_return: float | None = Field(default=None, description="For teachers and researchers that ask; else absent.")
    true_rewards: list[float] | None = Field(default=None, description="Per step; as true_return.")


class Query(Schema):
    """Two segments to compare, on the sides that were drawn for this user."""

    id: str = Field(description="qry_...")
    experiment_id: str = Field(description="exp_...")
    number: int = Field(description="1, 2, 3, ... within the experiment.")
    left: SegmentView = Field(description="What to show on the left.")
    right: SegmentView = Field(description="What to show on the right.")
    lease_seconds: float = Field(description="Send a heartbeat, or the label, before this is over.")


class Queries(Schema):
    """Queries leased to the caller."""

    items: list[Query] = Field(description="By number; those the caller held before come first.")
    reason: Literal["", "rendering", "policy_training", "all_labelled", "experiment_over", "paused"] = Field(
        default="", description="Why there are fewer than asked for."
    )


class NewLabel(Schema):
    """The answer to a query. Posting the same again changes nothing."""

    label: float | None = Field(
        strict=True, description="1, 0 or 0.5 (see `order`); null skips: it is stored, and never trained on."
    )
    order: Literal["segments", "shown"] = Field(
        default="segments",
        description="`segments`: 1 means that segment 0 is better. `shown`: 1 means that the left clip is better, "
        "and the server undoes the side that was drawn.",
    )
    response_seconds: float | None = Field(
        default=None, ge=0, le=86_400, description="From both clips playing to the answer."
    )
    teacher: dict[str, Any] = Field(
        default_factory=dict[str, Any], description="A scripted teacher's name and parameters."
    )


class Label(Schema):
    """The caller's label on a query, as it is stored."""

    query_id: str = Field(description="qry_...")
    label: float | None = Field(description="In segment order: 1 means that segment 0 is better; null is a skip.")
    state: Literal["label", "skip", "undone"] = Field(description="A skip is stored, and never trained on.")
    left_segment: int | None = Field(description="The segment shown on the left; null for a program.")
    revision: int = Field(description="Goes up by one with every change of a label of the experiment.")
    created: bool = Field(description="False when the same label was there already.")


class BatchLabel(NewLabel):
    """One label of many."""

    query_id: str = Field(description="qry_...")


class LabelBatch(Schema):
    """Labels of a program, written in one transaction."""

    labels: list[BatchLabel] = Field(min_length=1, max_length=1000, description="Each is judged by itself.")


class BatchOutcome(Schema):
    """What became of one label."""

    query_id: str = Field(description="As it was sent.")
    ok: bool = Field(description="Whether the label is stored.")
    label: Label | None = Field(default=None, description="The stored label, when ok.")
    code: str | None = Field(default=None, description="Stable error code when not ok.")
    message: str | None = Field(default=None, description="What was wrong and what to do, when not ok.")


class LabelBatchResult(Schema):
    """What became of every label, in the order they were sent."""

    items: list[BatchOutcome] = Field(description="One for each label.")


class Lease(Schema):
    """A query kept."""

    query_id: str = Field(description="qry_...")
    lease_seconds: float = Field(description="Send the next heartbeat before this is over.")


# Errors


class ErrorBody(Schema):
    """What went wrong."""

    code: str = Field(description="Stable; programs may rely on it.")
    message: str = Field(description="What was wrong and what to do.")
    details: list[dict[str, Any]] = Field(
        default_factory=list[dict[str, Any]],
        description="For an invalid value: `field`, for example policy.n_envs, and `problem`.",
    )


class ErrorResponse(Schema):
    """The body of every failure."""

    error: ErrorBody = Field(description="What went wrong.")
