"""A child process in one of a few characters, started by the tests of the supervisor.

`python -m tiny_process <character> <folder> --parent <pid>`; each start adds a line with its pid to <folder>/starts.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from mapt.processes import follow_parent


def main() -> None:
    character, folder, parent = sys.argv[1], Path(sys.argv[2]), int(sys.argv[4])
    if character == "deaf":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    follow_parent(parent, grace_seconds=0.2, check_seconds=0.05)
    if character == "parent":
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        (folder / "grandchild").write_text(str(child.pid))
    with (folder / "starts").open("a") as starts:
        starts.write(f"{os.getpid()}\n")
    if character == "broken":
        print("the cable is loose", file=sys.stderr)
        sys.exit(3)
    time.sleep(600)


if __name__ == "__main__":
    main()
