"""A supervisor in a separate process that tests can kill: `python -m supervisor_parent FOLDER BEHAVIOUR...`."""

import sys
from pathlib import Path

from accord.workers.runner import Stop
from accord.workers.supervisor import ChildSpec, Supervisor

folder = Path(sys.argv[1])
stop = Stop()
stop.install()
specs = [
    ChildSpec(
        f"{behaviour}-0",
        ("tiny_process", behaviour, str(folder)),
        environment={"PYTHONPATH": str(Path(__file__).parent)},
    )
    for behaviour in sys.argv[2:]
]
supervisor = Supervisor(specs, folder, lambda death: None)
while not stop.wait(0.02):
    supervisor.tick()
supervisor.shutdown(stop)
