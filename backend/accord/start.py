"""Starts a process of the service: `python -m accord.start MODULE [ARGUMENT ...]` runs the function `main` of a module.

As `python -m MODULE` would, but in half the CPU time from its start to its end (`mapt.processes.uncollected_imports`).
"""

import sys
from importlib import import_module

from mapt.processes import uncollected_imports


def main() -> int:
    """Returns the exit status of the process."""
    with uncollected_imports():
        module = import_module(sys.argv.pop(1))
    return module.main()


if __name__ == "__main__":
    sys.exit(main())
