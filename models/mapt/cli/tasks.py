"""mapt tasks: what there is to learn."""

from typing import Annotated

import typer

from mapt.cli.output import out
from mapt.tasks.registry import DEFAULT_AGENT_OBSK, task_listing


def tasks(
    *,
    agent_obsk: Annotated[
        int, typer.Option(min=0, help="How many joints away an agent sees; observations grow with it.")
    ] = DEFAULT_AGENT_OBSK,
) -> None:
    """List every task: agents N, observation C, action A of an agent, and steps of an episode."""
    out.print(task_listing(agent_obsk), markup=False)
