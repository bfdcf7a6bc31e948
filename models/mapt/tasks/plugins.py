"""Tasks from files outside this package: those that the variable MAPT_TASKS names.

A variable reaches every process that a service or a study starts, so the task is known to all of them.
"""

import os
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

from mapt.tasks.errors import TaskFileFailed

VARIABLE = "MAPT_TASKS"
_loaded: set[str] = set()


def load() -> None:
    """Run every file or module that MAPT_TASKS names and that has not run yet in this process.

    They stand in it as in PATH: paths of Python files, or names of modules, with colons between (semicolons on
    Windows). Each calls `mapt.tasks.register_task`.

    Raises:
        TaskFileFailed: if one is not there, or fails.
    """
    for name in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        if name not in _loaded:
            _loaded.add(name)
            try:
                _run(name)
            except Exception as error:
                _loaded.discard(name)
                raise TaskFileFailed(VARIABLE, name, error) from error


def _run(name: str) -> None:
    path = Path(name)
    if path.suffix != ".py":
        import_module(name)
        return
    spec = spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no Python file")
    spec.loader.exec_module(module_from_spec(spec))
