"""The subcommand `mapt train`."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, get_args

import typer

from mapt.cli.options import (
    AgentObsk,
    Algorithm,
    Device,
    Output,
    PolicySettings,
    Seeds,
    Steps,
    Task,
    Workers,
    parse_numbers,
)
from mapt.cli.output import ProgressBars, log_line, print_error
from mapt.errors import InvalidConfig
from mapt.policies import PolicyConfig
from mapt.processes import JobResult, cores_per_job, parallel_jobs, run_jobs, stop_requests
from mapt.rewards.checkpoints import load_reward_model
from mapt.rewards.model import PolicyReward
from mapt.settings import parse_assignments
from mapt.tasks.registry import DEFAULT_AGENT_OBSK, task_spec
from mapt.training.evaluation import Evaluation
from mapt.training.metrics import Metrics
from mapt.training.reward_source import reward_files
from mapt.training.run import RunJob, RunReport, do_run, do_run_in_worker
from mapt.training.settings import TRUE, ImitationSettings, LearnedRewardSettings, RunSettings

_STATUS_STOPPED = 130
_STATUS_FAILED = 2
#: policy settings that have options of their own
_OPTIONS = {"algorithm", "seed", "device"}


def train(
    *,
    output: Output,
    task: Task = "HalfCheetah-6x1",
    algorithm: Algorithm = "mappo",
    reward: Annotated[
        str,
        typer.Option(
            help="true for the task's own reward, or a reward model: a folder with reward.safetensors and "
            "reward.json, or a .safetensors file with its .json beside it. When the files are replaced, the next "
            "rollout uses the new model."
        ),
    ] = TRUE,
    steps: Steps = 1_000_000,
    seeds: Seeds = "0",
    settings: PolicySettings = None,
    agent_obsk: AgentObsk = DEFAULT_AGENT_OBSK,
    segment_steps: Annotated[
        int | None,
        typer.Option(min=1, help="Segment length T of the reward model.  [default: from its reward.json]"),
    ] = None,
    policy_reward: Annotated[
        str,
        typer.Option(help=f"Output of the reward model to train on: {', '.join(get_args(PolicyReward))}."),
    ] = "value",
    credit: Annotated[
        str,
        typer.Option(help="shared: every agent gets the mean learned reward; individual: each agent gets its own."),
    ] = "shared",
    evaluate_every: Annotated[
        int, typer.Option(min=0, help="Environment steps between evaluations; 0 evaluates only at the end.")
    ] = 0,
    checkpoint_minutes: Annotated[
        float, typer.Option(min=0, help="Minutes between checkpoints; 0 saves one after every iteration.")
    ] = 5.0,
    device: Device = "auto",
    workers: Workers = 0,
    physics_threads: Annotated[
        int, typer.Option(min=0, help="Simulator threads per seed; 0 divides the cores among the workers.")
    ] = 0,
    video: Annotated[bool, typer.Option(help="Record a video of the final policy.")] = True,
) -> None:
    """Train a policy per seed, evaluate it and record a video.

    Rerun the command to resume interrupted runs, or with more --steps to extend finished ones.
    """
    learned = None if reward == TRUE else _learned_reward(Path(reward), segment_steps, policy_reward, credit)
    own = _policy_settings(settings or [])
    runs = [
        RunSettings(
            task=task,
            policy=PolicyConfig.named(algorithm, **own, device=device, seed=seed),
            steps=steps,
            reward=learned,
            agent_obsk=agent_obsk,
            evaluate_every_steps=evaluate_every,
        )
        for seed in parse_numbers("--seeds", seeds, 0)
    ]
    task_spec(task, agent_obsk=agent_obsk)  # an unknown task is refused before a folder exists
    n_workers = parallel_jobs(workers, len(runs))
    threads = physics_threads or cores_per_job(n_workers)
    jobs = [RunJob(run, output / f"seed-{run.policy.seed}", checkpoint_minutes * 60, video, threads) for run in runs]
    train_all(jobs, n_workers)


def _policy_settings(settings: Sequence[str]) -> dict[str, object]:
    """The settings of `--set`. Raises InvalidConfig if one is malformed, or has an option of its own."""
    own = parse_assignments(settings)
    for name in _OPTIONS & own.keys():
        raise InvalidConfig(f"--set {name}: use --{'seeds' if name == 'seed' else name} instead.")
    return own


def _learned_reward(path: Path, segment_steps: int | None, kind: str, credit: str) -> LearnedRewardSettings:
    """The settings of a reward model on disk.

    Raises:
        InvalidConfig: if the segment length is unknown, or a value is out of its range.
        CheckpointError: if the model cannot be read.
    """
    found = load_reward_model(*reward_files(path)).segment_steps
    steps = segment_steps or found
    if steps is None:
        raise InvalidConfig(f"The reward.json of {path} has no segment_steps. Set --segment-steps.")
    return LearnedRewardSettings(str(path.resolve()), steps, kind, credit)  # pyright: ignore[reportArgumentType]  (validated by the class)


def train_all(jobs: Sequence[RunJob], n_workers: int) -> None:
    """Train every run; with several workers, a failed run does not affect the others.

    Raises:
        typer.Exit: if a run failed or was stopped.
        MaptError: with one worker, if a run fails; see `do_run`.
    """
    n_finished = n_failed = 0
    with ProgressBars() as bars, stop_requests() as stopped:
        progress = _RunProgress(bars)
        make = _train_in_turn if n_workers == 1 else partial(_train_in_parallel, n_workers)
        for done in make(jobs, progress, stopped):
            progress.finish(done.job, done.result)
            n_finished += done.result is not None
            if done.failure is not None:
                n_failed += 1
                print_error(f"seed {done.job.settings.policy.seed}: {done.failure}")
    if n_failed:
        raise typer.Exit(_STATUS_FAILED)
    if n_finished < len(jobs):
        print_error("Stopped. Rerun the command to resume.")
        raise typer.Exit(_STATUS_STOPPED)


class _RunProgress:
    """Draws a progress bar for each run, and logs its evaluation when it finishes."""

    def __init__(self, bars: ProgressBars) -> None:
        self._bars = bars
        #: mean return of each run's latest episodes, as text
        self._returns: dict[RunJob, str] = {}

    def start(self, job: RunJob) -> None:
        self._bars.add(job, _name(job), job.settings.steps)

    def update(self, job: RunJob, report: RunReport) -> None:
        if isinstance(report, str):
            log_line(f"{_name(job)}: {report}")
        else:
            self._bars.update(job, float(report["steps"]), self._state(job, report))

    def finish(self, job: RunJob, evaluation: Evaluation | None) -> None:
        self._bars.stop(job)
        if evaluation is not None:
            log_line(f"seed {job.settings.policy.seed}: {evaluation.describe()}; {job.folder}")

    def _state(self, job: RunJob, metrics: Metrics) -> str:
        if "true_return" in metrics:
            self._returns[job] = f"return {float(metrics['true_return']):,.0f}, "
        return f"{self._returns.get(job, '')}{float(metrics['steps_per_second']):,.0f} steps/s"


def _name(job: RunJob) -> str:
    settings = job.settings
    learned_from = settings.reward
    algorithm = learned_from.algorithm if isinstance(learned_from, ImitationSettings) else settings.policy.algorithm
    return f"{settings.task}, {algorithm}, seed {settings.policy.seed}"


def _train_in_turn(
    jobs: Sequence[RunJob], progress: _RunProgress, stopped: Callable[[], bool]
) -> Iterator[JobResult[RunJob, Evaluation | None]]:
    """Train the runs one after another in this process."""
    for job in jobs:
        if stopped():
            return
        progress.start(job)
        yield JobResult(job, do_run(job, partial(progress.update, job), stopped))


def _train_in_parallel(
    n_workers: int, jobs: Sequence[RunJob], progress: _RunProgress, stopped: Callable[[], bool]
) -> Iterator[JobResult[RunJob, Evaluation | None]]:
    """Train the runs in worker processes."""
    return run_jobs(
        do_run_in_worker, jobs, n_workers, on_start=progress.start, on_message=progress.update, should_stop=stopped
    )
