"""Logs of the service's processes: lines for people, or JSON, with what they are about.

Every line has the `worker_id` of its process (`api`, `policy-0`; `accord` for `accord up`), or of the process that it
is about. `structlog.contextvars` adds the `request_id` in the server, and the `experiment_id` in server and workers.
"""

import logging
import os
import sys
import threading
import time
from collections.abc import MutableMapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import structlog
from structlog.typing import Processor, WrappedLogger

LogFormat = Literal["text", "json"]
#: how often a process looks whether its log was renamed
_FOLLOW_SECONDS = 0.5


def configure(log_format: LogFormat, worker_id: str, file: Path | None = None) -> None:
    """Write the logs of this process to standard error.

    Args:
        worker_id: of this process.
        file: where standard output and error go. When it is renamed, they continue in a new file of this name.
    """
    common: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.stdlib.ExtraAdder(),
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        _default("worker_id", worker_id),
    ]
    renderers: list[Processor] = [
        structlog.dev.ConsoleRenderer(
            colors=sys.stderr.isatty(), pad_event_to=0, exception_formatter=structlog.dev.plain_traceback
        )
    ]
    if log_format == "json":
        renderers = [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=common,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *renderers],
        )
    )
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    logging.captureWarnings(True)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    if file is not None:
        threading.Thread(target=_follow, args=(file,), name="log-file", daemon=True).start()


def _default(name: str, value: str) -> Processor:
    """A processor that adds a field to lines without it."""

    def add(_logger: WrappedLogger, _method: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
        event.setdefault(name, value)
        return event

    return add


def _follow(file: Path) -> None:
    while True:
        # A full disk must not end this thread. Until the next look, lines go to the renamed file.
        with suppress(OSError):
            _reopen_if_renamed(file)
        time.sleep(_FOLLOW_SECONDS)


def _reopen_if_renamed(file: Path) -> None:
    stdout, stderr = 1, 2
    if file.exists() and os.path.samestat(file.stat(), os.fstat(stderr)):
        return
    descriptor = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    os.dup2(descriptor, stdout)
    os.dup2(descriptor, stderr)
    os.close(descriptor)
