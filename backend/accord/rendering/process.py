"""Clips made in a process of their own, which may hang or die without harm to its parent.

It is started by `subprocess` with its own environment, not by `multiprocessing`: that would import the parent's main
module again, and with it torch.
"""

import os
import socket
import struct
import subprocess
import sys
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Self

from accord.rendering.errors import RenderFailed, RenderTimedOut
from accord.rendering.protocol import ClipJob, Reply, receive_reply, send_job
from mapt.rendering.encode import ClipFile, partial_path
from mapt.rendering.environment import Backend, render_environment

#: starting takes 1 to 2 s; a busy machine may need ten times that
START_LIMIT_SECONDS = 60.0
#: handing a job over takes milliseconds
SEND_LIMIT_SECONDS = 5
#: an idle child ends as soon as its connection is closed
CLOSE_LIMIT_SECONDS = 5.0


class RenderProcess:
    """One render process, replaced whenever it hangs or dies.

    Belongs to one thread. That thread should live as long as the work lasts: on Linux the child is killed when the
    thread that started it ends, and the next clip pays for a new one.
    """

    def __init__(self, backend: Backend, clip_limit_seconds: float = 60.0) -> None:
        """Start the process; it warms up while the caller does other things.

        Args:
            backend: what `probe.probe_backend` found.
            clip_limit_seconds: a clip that takes longer is given up.
        """
        self._backend: Backend = backend
        self._clip_limit_seconds = clip_limit_seconds
        self._start()

    @property
    def pid(self) -> int:
        """Of the present child; another after a replacement."""
        return self._child.pid

    def render(self, job: ClipJob, limit_seconds: float | None = None) -> ClipFile:
        """Make one clip. It is at `job.path` whole when this returns; on an error nothing of it is left.

        Args:
            limit_seconds: for this clip, instead of the limit of all.

        Raises:
            RenderTimedOut: if it took longer than the limit. The process has been replaced.
            RenderFailed: if it could not be drawn or encoded, or the process died (and has been replaced).
        """
        limit_seconds = limit_seconds or self._clip_limit_seconds
        try:
            if not self._ready:
                self._await_reply(START_LIMIT_SECONDS)
                self._ready = True
            send_job(self._connection, job)
            reply = self._await_reply(limit_seconds)
        except RenderTimedOut:
            self._replace(job)
            raise
        except BlockingIOError as error:  # it did not even take the job
            self._replace(job)
            raise RenderTimedOut(SEND_LIMIT_SECONDS) from error
        except (EOFError, OSError) as error:
            status = self._replace(job)
            raise RenderFailed(f"The render process died ({status}) and was replaced.") from error
        if reply.clip is None:
            raise RenderFailed(f"The clip could not be made: {reply.failure}")
        return reply.clip

    def close(self) -> None:
        """End the process."""
        self._connection.close()
        try:
            self._child.wait(CLOSE_LIMIT_SECONDS)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._child = subprocess.Popen(
                [sys.executable, "-P", "-m", "accord.rendering.child", str(theirs.fileno()), str(os.getpid())],
                env=render_environment(self._backend),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # a Ctrl-C at the terminal reaches the parent alone
            )
        # A long job does not fit a socket's buffer: without a limit, a child that hangs would hang its parent.
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", SEND_LIMIT_SECONDS, 0))
        self._connection = Connection(ours.detach())
        self._ready = False

    def _await_reply(self, limit_seconds: float) -> Reply:
        if not self._connection.poll(limit_seconds):
            raise RenderTimedOut(limit_seconds)
        return receive_reply(self._connection)

    def _replace(self, job: ClipJob) -> str:
        """Kill the child, remove what it was writing, start another. Returns how the old one ended."""
        self._child.kill()
        status = self._child.wait()
        self._connection.close()
        partial_path(job.path, self._child.pid).unlink(missing_ok=True)
        self._start()
        return f"signal {-status}" if status < 0 else f"exit status {status}"
