"""mapt tasks: what there is to learn."""

from typing import Annotated

import typer
from rich.table import Table

from mapt.cli.output import out
from mapt.tasks import task_names, task_spec
from mapt.tasks.registry import DEFAULT_AGENT_OBSK


def tasks(
    *,
    agent_obsk: Annotated[
        int, typer.Option(min=0, help="How many joints away an agent sees; observations grow with it.")
    ] = DEFAULT_AGENT_OBSK,
) -> None:
    """List every task: agents N, observation C, action A of an agent, and steps of an episode."""
    out.print(task_table(agent_obsk))


def task_table(agent_obsk: int) -> Table:
    """One row per task; an agent that drives less than others shows how much it drives."""
    table = Table("task", box=None, pad_edge=False)
    for heading in ("N", "C", "A", "horizon", "state", "step, s"):
        table.add_column(heading, justify="right")
    for name in task_names():
        spec = task_spec(name, agent_obsk=agent_obsk)
        kind = " choices" if spec.discrete_actions else ""
        table.add_row(
            name,
            str(spec.n_agents),
            str(spec.observation_dim),
            f"{_range(spec.agent_action_dims or (spec.action_dim,))}{kind}",
            str(spec.horizon_steps),
            str(spec.state_dim),
            f"{spec.step_seconds:g}",
        )
    return table


def _range(dims: tuple[int, ...]) -> str:
    return str(dims[0]) if min(dims) == max(dims) else f"{min(dims)}-{max(dims)}"
