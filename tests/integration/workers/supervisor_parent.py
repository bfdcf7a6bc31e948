"""A supervisor in a process of its own, to be killed: `python -m supervisor_parent <folder> <character>...`."""

import sys
from pathlib import Path

from accord.workers.runner import Stop
from accord.workers.supervisor import ChildSpec, Supervisor

folder = Path(sys.argv[1])
stop = Stop()
stop.install()
specs = [
    ChildSpec(
        f"{character}-0",
        ("tiny_process", character, str(folder)),
        environment={"PYTHONPATH": str(Path(__file__).parent)},
    )
    for character in sys.argv[2:]
]
supervisor = Supervisor(specs, folder, lambda death: None)
while not stop.wait(0.02):
    supervisor.tick()
supervisor.shutdown(stop)
