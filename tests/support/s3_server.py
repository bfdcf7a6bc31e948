"""An S3 server for tests: rclone, which keeps the objects in a folder, so that it can be stopped and started again."""

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from support.ports import free_port
from support.waiting import until

_RCLONE = Path(sys.executable).with_name("rclone")
_BUCKET = "accord"
_KEY_ID, _SECRET = "accord", "a-secret-of-tests"


class S3Server:
    """One bucket on a free port. Its process is killed at the end of the block."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._port = free_port()
        self._process: subprocess.Popen[bytes] | None = None
        (folder / _BUCKET).mkdir(parents=True)

    @property
    def environment(self) -> dict[str, str]:
        """The variables with which clients find it and sign their requests."""
        return {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self._port}",
            "AWS_ACCESS_KEY_ID": _KEY_ID,
            "AWS_SECRET_ACCESS_KEY": _SECRET,
            "AWS_REGION": "us-east-1",
        }

    def url(self, prefix: str) -> str:
        """The URL of a blob store in its bucket."""
        return f"s3://{_BUCKET}/{prefix}"

    def start(self) -> None:
        """Start it, again after `stop` with the same objects."""
        command = [_RCLONE, "serve", "s3", str(self._folder), "--addr", f"127.0.0.1:{self._port}"]
        self._process = subprocess.Popen(
            [*command, "--auth-key", f"{_KEY_ID},{_SECRET}"],
            env=os.environ | {"RCLONE_CONFIG": os.devnull},
            stderr=subprocess.DEVNULL,
        )
        until(self._accepts, "the S3 server listens")

    def stop(self) -> None:
        """Kill it: clients then cannot connect."""
        if self._process is not None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()

    def __enter__(self) -> "S3Server":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _accepts(self) -> bool:
        with suppress(OSError), socket.create_connection(("127.0.0.1", self._port), 1.0):
            return True
        return False
