"""mapt train: a policy from its first step to its video, without the service."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, get_args

import typer

from mapt.benchmarks.specification import numbers, setting
from mapt.cli.options import Device, Task, Workers
from mapt.cli.output import Bars, RunBars, complain
from mapt.errors import InvalidConfig
from mapt.policies import Algorithm, PolicyConfig
from mapt.processes import JobResult, cores_per_job, parallel_jobs, run_jobs, stop_requests
from mapt.rewards.checkpoints import load_reward_model
from mapt.rewards.model import PolicyReward
from mapt.rewards.relabelling import Credit
from mapt.tasks.registry import DEFAULT_AGENT_OBSK
from mapt.training.evaluation import Evaluation
from mapt.training.reward_source import reward_files
from mapt.training.run import RunJob, do_run, do_run_in_worker
from mapt.training.settings import TRUE, LearnedRewardSettings, RunSettings

_NOTED_SHARE = 0.1
#: status of a command that was asked to stop
_STOPPED = 130
#: status of a command of which a run failed
_FAILED = 2
#: settings of a policy that are options of their own
_OPTIONS = {"algorithm", "seed", "device"}


def train(
    *,
    output: Annotated[Path, typer.Option(help="Folder of the runs: one folder in it for each seed.")],
    task: Task = "HalfCheetah-6x1",
    algorithm: Annotated[str, typer.Option(help=f"One of {', '.join(get_args(Algorithm))}.")] = "mappo",
    reward: Annotated[
        str,
        typer.Option(
            help="true, or a reward model: a folder of reward.safetensors and reward.json, or a .safetensors file with "
            "its .json beside it. When it is replaced, the next rollout gets the new one."
        ),
    ] = TRUE,
    steps: Annotated[int, typer.Option(min=1, help="Environment steps of each run.")] = 1_000_000,
    seed: Annotated[str, typer.Option(help="Seeds, with commas between; each is a run of its own.")] = "0",
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="A setting of the policy, such as clip=0.2; as often as wanted."
        ),
    ] = None,
    agent_obsk: Annotated[int, typer.Option(min=0, help="How many joints away an agent sees.")] = DEFAULT_AGENT_OBSK,
    segment_steps: Annotated[
        int | None,
        typer.Option(min=1, help="Steps that the reward model looks back on, T.  [default: what its card says]"),
    ] = None,
    policy_reward: Annotated[
        str, typer.Option(help=f"What of the reward model the policy is given: {', '.join(get_args(PolicyReward))}.")
    ] = "value",
    credit: Annotated[
        str, typer.Option(help=f"{' or '.join(get_args(Credit))}: the mean learned reward for all, or each its own.")
    ] = "shared",
    evaluate_every: Annotated[
        int, typer.Option(min=0, help="Environment steps between evaluations; 0 for one at the end alone.")
    ] = 0,
    checkpoint_minutes: Annotated[
        float, typer.Option(min=0, help="Minutes between checkpoints; 0 for one after every iteration.")
    ] = 5.0,
    device: Device = "auto",
    workers: Workers = 0,
    physics_threads: Annotated[
        int, typer.Option(min=0, help="Threads that step the task of a seed; 0 shares the cores out.")
    ] = 0,
    video: Annotated[bool, typer.Option(help="Make a video of the final policy.")] = True,
) -> None:
    """Train a policy with each seed, measure it and film it.

    The same command goes on with runs that were ended; with more steps it makes finished ones longer.
    """
    learned = None if reward == TRUE else _learned(Path(reward), segment_steps, policy_reward, credit)
    own = _own(settings or [])
    runs = [
        RunSettings(
            task=task,
            policy=PolicyConfig.named(algorithm, **own, device=device, seed=number),
            steps=steps,
            reward=learned,
            agent_obsk=agent_obsk,
            evaluate_every_steps=evaluate_every,
        )
        for number in numbers("--seed", seed, 0)
    ]
    n_workers = parallel_jobs(workers, len(runs))
    threads = physics_threads or cores_per_job(n_workers)
    jobs = [RunJob(run, output / f"seed-{run.policy.seed}", checkpoint_minutes * 60, video, threads) for run in runs]
    _train_all(jobs, n_workers)


def _own(settings: Sequence[str]) -> dict[str, object]:
    """Raises InvalidConfig."""
    own = dict(setting(text) for text in settings)
    for name in _OPTIONS & own.keys():
        raise InvalidConfig(f"--set {name}: give --{name} instead.")
    return own


def _learned(path: Path, segment_steps: int | None, kind: str, credit: str) -> LearnedRewardSettings:
    """Raises InvalidConfig, CheckpointError."""
    steps = segment_steps or load_reward_model(*reward_files(path)).segment_steps
    if steps is None:
        raise InvalidConfig(f"The card of {path} does not say what T was; give --segment-steps.")
    return LearnedRewardSettings(str(path.resolve()), steps, kind, credit)  # pyright: ignore[reportArgumentType]  (checked on creation)


def _train_all(jobs: Sequence[RunJob], n_workers: int) -> None:
    """Make every run that can be made; a failure of one of several at once leaves the others be.

    Raises:
        typer.Exit: if not all were finished.
        See `do_run` for what else, of runs in turn.
    """
    n_finished = n_failed = 0
    with Bars(_NOTED_SHARE) as drawn, stop_requests() as stopped:
        bars = RunBars(drawn)
        make = _make_in_turn if n_workers == 1 else partial(_make_at_once, n_workers)
        for done in make(jobs, bars, stopped):
            bars.end(done.job, done.result)
            n_finished += done.result is not None
            if done.failure is not None:
                n_failed += 1
                complain(f"seed {done.job.settings.policy.seed}: {done.failure}")
    if n_failed:
        raise typer.Exit(_FAILED)
    if n_finished < len(jobs):
        complain("Stopped; the same command goes on.")
        raise typer.Exit(_STOPPED)


def _make_in_turn(
    jobs: Sequence[RunJob], bars: RunBars, stopped: Callable[[], bool]
) -> Iterator[JobResult[RunJob, Evaluation | None]]:
    """In this process."""
    for job in jobs:
        if stopped():
            return
        bars.begin(job)
        yield JobResult(job, do_run(job, partial(bars.tell, job), stopped))


def _make_at_once(
    n_workers: int, jobs: Sequence[RunJob], bars: RunBars, stopped: Callable[[], bool]
) -> Iterator[JobResult[RunJob, Evaluation | None]]:
    return run_jobs(do_run_in_worker, jobs, n_workers, on_start=bars.begin, on_message=bars.tell, should_stop=stopped)
