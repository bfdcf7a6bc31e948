"""What can go wrong with a task.

TaskError
├── UnknownTask
├── TaskExists
├── TaskFileFailed
├── NoSimulator
├── NoPicture
├── UnusableEnvironment
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


class TaskExists(TaskError):
    """Another task has this name."""

    def __init__(self, name: str) -> None:
        super().__init__(f"There is a task called {name!r} already; give yours another name.")
        self.name = name


class TaskFileFailed(TaskError):
    """A file or module that should bring tasks is not there, or fails."""

    def __init__(self, variable: str, name: str, error: Exception) -> None:
        super().__init__(f"{variable} names {name!r}, which could not be loaded: {type(error).__name__}: {error}.")
        self.name = name


class NoSimulator(TaskError):
    """The task is not simulated by MuJoCo here, so nothing can be drawn from its states."""

    def __init__(self, name: str) -> None:
        super().__init__(f"{name} is not simulated by MuJoCo here, so there is no model to draw it from.")
        self.name = name


class NoPicture(TaskError):
    """The environment does not draw itself."""


class UnusableEnvironment(TaskError):
    """A foreign environment is not of the kind that the adapter can batch."""


class InvalidTaskOption(TaskError, ValueError):
    """An option of a task is out of its range."""


class InvalidAction(TaskError, ValueError):
    """Actions of the wrong shape, or not finite."""


class InvalidSnapshot(TaskError, ValueError):
    """A snapshot was taken from another task or another number of environments."""
