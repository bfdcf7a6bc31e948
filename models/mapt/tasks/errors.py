"""What can go wrong with a task.

TaskError
├── UnknownTask
├── InvalidTaskOption
├── InvalidAction
└── InvalidSnapshot
"""


class TaskError(Exception):
    """A task could not be made or used."""


class UnknownTask(TaskError):
    """No task has this name."""

    def __init__(self, name: str, known: tuple[str, ...]) -> None:
        super().__init__(f"No task is called {name!r}. Known tasks: {', '.join(known)}.")
        self.name = name
        self.known = known


class InvalidTaskOption(TaskError, ValueError):
    """An option of a task is out of its range."""


class InvalidAction(TaskError, ValueError):
    """Actions of the wrong shape, or not finite."""


class InvalidSnapshot(TaskError, ValueError):
    """A snapshot was taken from another task or another number of environments."""
