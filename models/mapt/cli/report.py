"""mapt report: what trained reward models are like."""

from pathlib import Path
from typing import Annotated

import typer

from mapt.cli.output import say
from mapt.rewards.checkpoints import CARD_FILE, WEIGHTS_FILE, load_reward_model
from mapt.rewards.model import RewardModel
from mapt.studies.errors import InvalidStudy
from mapt.studies.replay import Replay
from mapt.studies.report import ReportPlan, make_report


def report(
    checkpoints: Annotated[
        list[str],
        typer.Argument(help=f"Folders of {WEIGHTS_FILE} and {CARD_FILE}; NAME=FOLDER gives a model a name."),
    ],
    *,
    replay: Annotated[Path, typer.Option(help="Folder of one replay, such as seed-0 of `mapt dataset`.")],
    output: Annotated[Path, typer.Option(help="Folder of report.html, report.json and the pictures.")],
    teacher: Annotated[str, typer.Option(help="Scripted teacher who labels pairs for the calibration.")] = "oracle",
    pairs: Annotated[int, typer.Option(min=1, help="Pairs that it labels.")] = 4000,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, help="Take only segments that no cell of `mapt table` with this seed learns from.  [default: all]"
        ),
    ] = None,
) -> None:
    """Show learned beside true rewards, what the attentions look at, and how sure the model may be."""
    models = load_models(checkpoints)
    for path in make_report(models, Replay.open(replay), ReportPlan(teacher, pairs, seed), output):
        say(f"[dim]{path}[/dim]")


def load_models(checkpoints: list[str]) -> dict[str, RewardModel]:
    """Models by name.

    Raises:
        InvalidStudy: if two have the same name.
        CheckpointError: if one cannot be read.
    """
    models: dict[str, RewardModel] = {}
    for text in checkpoints:
        # A folder's own name may hold an equals sign.
        name, equals, folder = ("", "", text) if Path(text).is_dir() else text.partition("=")
        path = Path(folder if equals or not name else text)
        name = name if equals else path.name
        if name in models:
            raise InvalidStudy(f"two models are called {name!r}; give them names: NAME=FOLDER")
        models[name] = load_reward_model(path / WEIGHTS_FILE, path / CARD_FILE).model
    return models
