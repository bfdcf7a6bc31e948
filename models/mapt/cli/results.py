"""mapt evaluate: what a trained policy gets."""

import json
from pathlib import Path
from typing import Annotated

import typer

from mapt.benchmarks.specification import numbers
from mapt.cli.options import Device
from mapt.cli.output import out, say, sentence
from mapt.training.curves import draw_curves
from mapt.training.evaluation import EPISODES, evaluate_policy
from mapt.training.results import RunResult, find_runs, grouped, markdown
from mapt.training.run_folder import load_policy
from mapt.training.video import record_video


def evaluate(
    run: Annotated[Path, typer.Argument(help="Folder of a run, or a checkpoint of a policy.")],
    *,
    episodes: Annotated[int, typer.Option(min=1, help="Whole episodes to play.")] = EPISODES,
    seed: Annotated[int, typer.Option(min=0, help="Decides their starts.")] = 0,
    agent_obsk: Annotated[
        int | None, typer.Option(min=0, help="How many joints away an agent sees.  [default: what the run says, or 1]")
    ] = None,
    device: Device = "auto",
    video: Annotated[Path | None, typer.Option(help="Film an episode too, to this mp4.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, with every episode.")] = False,
) -> None:
    """Play whole episodes with mean actions: mean, spread and interquartile mean of the true return."""
    saved = load_policy(run, device, agent_obsk)
    evaluation = evaluate_policy(saved.policy, saved.task, agent_obsk=saved.agent_obsk, episodes=episodes, seed=seed)
    about = {"task": saved.task, "algorithm": saved.algorithm, "steps": saved.steps}
    if as_json:
        out.print_json(json.dumps(about | evaluation.to_dict()), highlight=False)
    else:
        say(f"{saved.task}, {saved.algorithm} after {saved.steps:,} steps: {sentence(evaluation)}")
    if video is not None:
        record_video(saved.policy, saved.task, video, agent_obsk=saved.agent_obsk, seed=seed)
        if not as_json:
            say(f"[dim]{video}[/dim]")


def curves(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs, or folders that hold such.")],
    *,
    output: Annotated[Path, typer.Option(help="The picture, as png, pdf or svg.")],
    table: Annotated[Path | None, typer.Option(help="Markdown table to write beside it.")] = None,
    steps: Annotated[
        str | None,
        typer.Option(
            help="Steps that the table tells of, with commas between; `--evaluate-every` of `mapt train` makes them.  "
            "[default: the last evaluation]"
        ),
    ] = None,
) -> None:
    """Draw true return over steps, mean and spread over seeds, for each task, algorithm and reward."""
    milestones = numbers("--steps", steps, 1) if steps else ()
    groups = grouped([RunResult.read(folder) for folder in find_runs(runs)])
    output.parent.mkdir(parents=True, exist_ok=True)
    draw_curves(groups, output)
    say(f"[dim]{output}[/dim]")
    if table is not None:
        table.parent.mkdir(parents=True, exist_ok=True)
        table.write_text(markdown(groups, milestones))
        say(f"[dim]{table}[/dim]")
