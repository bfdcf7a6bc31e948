"""accord tasks: what an experiment can be made of."""

from accord.cli.output import out
from accord.domain.errors import Unavailable
from mapt.errors import TaskError
from mapt.tasks.registry import DEFAULT_AGENT_OBSK, task_listing


def tasks() -> None:
    """List every task: agents N, observation C, action A of an agent, and steps of an episode."""
    try:
        out.print(task_listing(DEFAULT_AGENT_OBSK), markup=False)
    except TaskError as error:
        raise Unavailable(str(error)) from error
