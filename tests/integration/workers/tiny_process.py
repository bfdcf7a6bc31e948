"""A child process with one of several behaviours, started by the tests of the supervisor.

`python -m accord.start tiny_process BEHAVIOUR FOLDER --parent PID --log FILE`. Every start appends its pid to
FOLDER/starts.

Behaviours: `sleep` ends at SIGTERM, `ignore-sigterm` does not, `fail` exits with status 3, `spawn` starts a process of
its own, and `log` logs numbered lines until FOLDER/stop exists. All but `fail` run for ten minutes.
"""

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from accord import logs
from mapt.processes import follow_parent

log = logging.getLogger(__name__)


def main() -> None:
    behaviour, folder, parent = sys.argv[1], Path(sys.argv[2]), int(sys.argv[4])
    if behaviour == "ignore-sigterm":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    follow_parent(parent, grace_seconds=0.2, check_seconds=0.05)
    if behaviour == "spawn":
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        (folder / "grandchild").write_text(str(child.pid))
    with (folder / "starts").open("a") as starts:
        starts.write(f"{os.getpid()}\n")
    if behaviour == "fail":
        print("simulated failure", file=sys.stderr)
        sys.exit(3)
    if behaviour == "log":
        logs.configure("json", "log-0", Path(sys.argv[6]))
        for number in range(600_000):
            if (folder / "stop").exists():
                (folder / "stopped").touch()
                break
            log.info("line", extra={"number": number})
    time.sleep(600)


if __name__ == "__main__":
    main()
