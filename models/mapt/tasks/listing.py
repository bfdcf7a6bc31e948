"""All tasks in plain lines, for the commands that list them: without torch, which takes seconds to import."""

from mapt.tasks.registry import task_names, task_spec

_HEADINGS = ("task", "N", "C", "A", "horizon", "state", "step, s")


def task_listing(agent_obsk: int) -> str:
    """One line per task under a line of headings; an agent that drives less than others shows how much it drives.

    Args:
        agent_obsk: as of `make_task`; observations grow with it.

    Raises:
        TaskFileFailed: if a file that MAPT_TASKS names is not there, or fails.
    """
    rows = [_HEADINGS, *(_row(name, agent_obsk) for name in task_names())]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(_line(row, widths) for row in rows)


def _row(name: str, agent_obsk: int) -> tuple[str, ...]:
    spec = task_spec(name, agent_obsk=agent_obsk)
    dims = spec.agent_action_dims or (spec.action_dim,)
    least, most = min(dims), max(dims)
    return (
        name,
        str(spec.n_agents),
        str(spec.observation_dim),
        f"{most if least == most else f'{least}-{most}'}{' choices' if spec.discrete_actions else ''}",
        str(spec.horizon_steps),
        str(spec.state_dim),
        f"{spec.step_seconds:g}",
    )


def _line(row: tuple[str, ...], widths: list[int]) -> str:
    name, *numbers = row
    return "  ".join((name.ljust(widths[0]), *map(str.rjust, numbers, widths[1:])))
