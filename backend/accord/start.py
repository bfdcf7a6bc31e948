"""Starts a process of the service: `python -m accord.start MODULE [ARGUMENT ...]` runs the function `main` of a module.

As `python -m MODULE` would, but without garbage collection while modules are imported, and without looking at them in
later collections. Half of the processor time of a worker that started and ended went into collections: among imports
that create hundreds of thousands of objects and no garbage, and at exit.
"""

import gc
import sys
from importlib import import_module


def main() -> int:
    """Returns the exit status of the process."""
    gc.disable()
    module = import_module(sys.argv.pop(1))
    gc.enable()
    gc.freeze()
    return module.main()


if __name__ == "__main__":
    sys.exit(main())
