"""A policy from a file: of a run, of the service, or as `Learner.save` leaves it."""

from dataclasses import dataclass, replace
from pathlib import Path

from mapt.policies import InvalidCheckpoint, Policy, PolicyConfig
from mapt.policies.checkpoint import describe, refusing_mismatch, unflatten, unpack
from mapt.policies.device import resolve_device
from mapt.policies.learner import make_policy
from mapt.runs.checkpoint import PolicyCheckpoint
from mapt.runs.errors import RunNotFound
from mapt.runs.folder import CHECKPOINT_FILE, RUN_FILE, RunFolder
from mapt.tasks import task_spec
from mapt.tasks.registry import DEFAULT_AGENT_OBSK


@dataclass(frozen=True, slots=True)
class SavedPolicy:
    """A policy that only acts."""

    policy: Policy
    task: str
    agent_obsk: int
    algorithm: str
    #: environment steps that it was trained for
    steps: int


def load_policy(path: Path, device: str = "auto", agent_obsk: int | None = None) -> SavedPolicy:
    """The policy of a run's folder or of a checkpoint.

    Args:
        device: where it acts, whatever it was trained on.
        agent_obsk: how many joints away its agents see; None for the run's own, or the usual where there is no run.

    Raises:
        RunNotFound: if there is none.
        mapt.policies.InvalidCheckpoint: if the file is damaged, no checkpoint, or of other observations.
    """
    file = path / CHECKPOINT_FILE if path.is_dir() else path
    if not file.is_file():
        raise RunNotFound(path)
    if agent_obsk is None:
        in_run = (file.parent / RUN_FILE).exists()
        agent_obsk = RunFolder(file.parent).settings().agent_obsk if in_run else DEFAULT_AGENT_OBSK
    return policy_of(learner_bytes(file), device, agent_obsk)


def learner_bytes(file: Path) -> bytes:
    """What `Learner.to_bytes` gave, which a run's checkpoint holds inside."""
    content = file.read_bytes()
    try:
        describe(content)
    except InvalidCheckpoint:
        return PolicyCheckpoint.from_bytes(content).learner
    return content


def policy_of(content: bytes, device: str, agent_obsk: int) -> SavedPolicy:
    """The policy of `Learner.to_bytes`, without its learner."""
    description = describe(content)
    config = replace(PolicyConfig.from_dict(description.config), device=device)
    tensors, _ = unpack(content, description.task)
    policy = make_policy(task_spec(description.task, agent_obsk=agent_obsk), config).to(resolve_device(device))
    with refusing_mismatch():
        parts = unflatten(tensors)
        for name, network in policy.named_children():
            network.load_state_dict(parts[name])
        steps = int(parts["learner"]["steps"])
    return SavedPolicy(policy, description.task, agent_obsk, config.algorithm, steps)
