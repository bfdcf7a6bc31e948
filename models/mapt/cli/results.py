"""The subcommands `mapt evaluate` and `mapt curves`."""

from pathlib import Path
from typing import Annotated

import typer

from mapt.cli.options import Device, Json, parse_numbers
from mapt.cli.output import print_json, print_line, print_paths
from mapt.io import atomic_write
from mapt.training.curves import draw_curves
from mapt.training.evaluation import EPISODES, evaluate_policy
from mapt.training.results import RunResult, find_runs, grouped, markdown, returns_table
from mapt.training.run_folder import load_policy
from mapt.training.video import record_video


def evaluate(
    run: Annotated[Path, typer.Argument(help="Run folder, or a policy checkpoint.")],
    *,
    episodes: Annotated[int, typer.Option(min=1, help="Number of whole episodes.")] = EPISODES,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the initial states.")] = 0,
    agent_obsk: Annotated[
        int | None,
        typer.Option(min=0, help="How many joints away an agent observes.  [default: as in run.json, or 1]"),
    ] = None,
    device: Device = "auto",
    video: Annotated[Path | None, typer.Option(help="Record one episode to this mp4 file.")] = None,
    as_json: Json = False,
) -> None:
    """Evaluate a trained policy by the true reward.

    The policy acts by its mean actions. Prints mean, standard deviation and interquartile mean of the return.
    """
    saved = load_policy(run, device, agent_obsk)
    evaluation = evaluate_policy(saved.policy, saved.task, agent_obsk=saved.agent_obsk, episodes=episodes, seed=seed)
    about = {"task": saved.task, "algorithm": saved.algorithm, "steps": saved.steps}
    if as_json:
        print_json(about | evaluation.to_dict())
    else:
        print_line(f"{saved.task}, {saved.algorithm} after {saved.steps:,} steps: {evaluation.describe()}")
    if video is not None:
        record_video(saved.policy, saved.task, video, agent_obsk=saved.agent_obsk, seed=seed)
        if not as_json:
            print_paths(video)


def curves(
    runs: Annotated[list[Path], typer.Argument(help="Run folders, or folders that contain runs at any depth.")],
    *,
    output: Annotated[Path, typer.Option(help="Image to write: png, pdf or svg.")],
    table: Annotated[Path | None, typer.Option(help="Markdown table to write as well.")] = None,
    milestones: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated environment steps to tabulate; `mapt train --evaluate-every` evaluates at them.  "
            "[default: the last evaluation]"
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Plot and tabulate the true return of runs.

    Runs that differ only in their seed form one line: mean and standard deviation over seeds. Reads the runs of
    `mapt train` and `accord demo`.
    """
    steps = parse_numbers("--milestones", milestones, 1) if milestones else ()
    groups = grouped([RunResult.read(folder) for folder in find_runs(runs)])
    written = [output]
    output.parent.mkdir(parents=True, exist_ok=True)
    draw_curves(groups, output)
    if table is not None:
        table.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(table, markdown(groups, steps).encode())
        written.append(table)
    if as_json:
        print_json(returns_table(groups, steps))
    else:
        print_paths(*written)
