"""mapt train: a policy from its first step to its video, without the service."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, get_args

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mapt.cli.options import Device, Task
from mapt.cli.output import complain, note, on_terminal, out
from mapt.policies import Algorithm, PolicyConfig
from mapt.rewards.base import PolicyReward
from mapt.rewards.checkpoints import load_reward_model
from mapt.rewards.relabelling import Credit
from mapt.runs.complete import complete_run
from mapt.runs.errors import InvalidRun
from mapt.runs.evaluation import Evaluation
from mapt.runs.folder import RunFolder
from mapt.runs.metrics_file import Metrics
from mapt.runs.reward_source import reward_files
from mapt.runs.settings import TRUE, LearnedRewardSettings, RunSettings
from mapt.runs.stopping import stop_requests
from mapt.runs.training import Watch
from mapt.studies.naming import numbers, setting
from mapt.tasks.registry import DEFAULT_AGENT_OBSK

#: without a terminal, a line each time so much more is done
_NOTED_SHARE = 0.1
#: status of a command that was asked to stop
_STOPPED = 130
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
    physics_threads: Annotated[
        int, typer.Option(min=0, help="Threads that step the task; 0 for one per core, 1 beside other runs.")
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
    folders = [RunFolder(output / f"seed-{run.policy.seed}") for run in runs]
    if not _train_all(runs, folders, checkpoint_minutes * 60, video=video, physics_threads=physics_threads):
        complain("Stopped; the same command goes on.")
        raise typer.Exit(_STOPPED)


def _own(settings: Sequence[str]) -> dict[str, object]:
    """Raises InvalidStudy, InvalidRun."""
    own = dict(setting(text) for text in settings)
    for name in _OPTIONS & own.keys():
        raise InvalidRun(f"--set {name}: give --{name} instead.")
    return own


def _learned(path: Path, segment_steps: int | None, kind: str, credit: str) -> LearnedRewardSettings:
    """Raises InvalidRun, CheckpointError."""
    steps = segment_steps or load_reward_model(*reward_files(path)).segment_steps
    if steps is None:
        raise InvalidRun(f"The card of {path} does not say what T was; give --segment-steps.")
    return LearnedRewardSettings(str(path.resolve()), steps, kind, credit)  # pyright: ignore[reportArgumentType]  (checked on creation)


def _train_all(
    runs: Sequence[RunSettings],
    folders: Sequence[RunFolder],
    checkpoint_seconds: float,
    *,
    video: bool,
    physics_threads: int,
) -> bool:
    """One run after the other. Returns whether all were finished."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"))
    with (
        Progress(
            *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=out, disable=not on_terminal()
        ) as progress,
        stop_requests() as stopped,
    ):
        for run, folder in zip(runs, folders, strict=True):
            with _shown(run, progress) as show:
                watch = Watch(on_iteration=show, note=note, stopped=stopped)
                evaluation = complete_run(
                    run, folder, checkpoint_seconds, watch, video=video, physics_threads=physics_threads
                )
            if evaluation is None:
                return False
            note(f"seed {run.policy.seed}: {sentence(evaluation)}; {folder.path}")
    return True


@contextmanager
def _shown(run: RunSettings, progress: Progress) -> Iterator["_Bar"]:
    bar = _Bar(run, progress)
    try:
        yield bar
    finally:
        bar.stop()


class _Bar:
    """How far a run is, on the terminal; where there is none, a line now and then."""

    def __init__(self, run: RunSettings, progress: Progress) -> None:
        self._run, self._progress = run, progress
        self._name = f"{run.task}, {run.policy.algorithm}, seed {run.policy.seed}"
        self._bar = progress.add_task(self._name, total=run.steps, state="")
        self._noted, self._return = 0.0, ""

    def __call__(self, metrics: Metrics) -> None:
        steps = float(metrics["steps"])
        if "true_return" in metrics:
            self._return = f"true return {float(metrics['true_return']):,.0f}, "
        state = f"{self._return}{float(metrics['steps_per_second']):,.0f} steps/s"
        self._progress.update(self._bar, completed=min(steps, self._run.steps), state=state)
        share = min(1.0, steps / self._run.steps)
        if not on_terminal() and share >= self._noted + _NOTED_SHARE:
            self._noted = share
            note(f"{self._name}: {share:.0%}, {state}")

    def stop(self) -> None:
        self._progress.stop_task(self._bar)


def sentence(evaluation: Evaluation) -> str:
    """What the episodes of an evaluation were like."""
    found = evaluation.summary()
    return (
        f"true return {found['mean']:,.1f} ± {found['std']:,.1f} (interquartile mean {found['iqm']:,.1f}) "
        f"over {len(evaluation.returns)} episodes of {found['length']:,.0f} steps"
    )
