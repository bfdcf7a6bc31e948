"""Output of the `mapt` and `accord` commands: lines, errors, JSON and progress bars.

If stdout is not a terminal, output is plain text and progress is logged as lines.
"""

import json
import sys
from collections.abc import Hashable
from dataclasses import dataclass
from datetime import datetime
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

out = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 100)
err = Console(stderr=True, highlight=False, soft_wrap=True)


def print_line(text: str) -> None:
    """Print a line of rich markup."""
    out.print(text)


def print_paths(*paths: object) -> None:
    """Print the files that a command wrote, one on a line."""
    for path in paths:
        out.print(f"[dim]{escape(str(path))}[/dim]")


def print_json(value: object) -> None:
    """Print JSON; NaN and infinities become null."""
    out.print_json(json.dumps(_finite(value)), highlight=False)


def log_line(text: str, source: str = "") -> None:
    """Print a line with the time and, if given, its source. `text` is not markup."""
    now = datetime.now().astimezone().strftime("%H:%M:%S")
    out.print(f"[dim]{now}[/dim] " + (f"[bold]{escape(source)}[/bold] " if source else "") + escape(text))


def print_error(text: str, program: str = "mapt") -> None:
    """Print an error on stderr, after the program's name."""
    err.print(f"[bold red]{program}:[/bold red] {escape(text)}")


def on_terminal() -> bool:
    """Whether stdout is a terminal."""
    return sys.stdout.isatty()


class ProgressBars:
    """Progress bars of several jobs.

    Args:
        log_every: if stdout is not a terminal, log a line each time a job has progressed by this fraction.
        hidden: draw and log nothing, for `--json`.
    """

    def __init__(self, log_every: float = 0.1, *, hidden: bool = False) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"))
        self._progress = Progress(
            *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=out, disable=hidden or not on_terminal()
        )
        self._log_every = log_every
        self._logs = not hidden and not on_terminal()
        self._bars: dict[Hashable, _Bar] = {}

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Before version 14.3, rich prints an empty line when a display that is not drawn stops.
        if not self._progress.disable:
            self._progress.stop()

    def add(self, job: Hashable, name: str, total: float, done: float = 0.0) -> None:
        """Add the bar of a job."""
        bar = self._progress.add_task(name, total=total, state="")
        self._progress.update(bar, completed=done)
        self._bars[job] = _Bar(name, total, bar, logged=done / total if total else 0.0)

    def update(self, job: Hashable, done: float, state: str = "") -> None:
        """Set how much of a job is done, and the text beside its bar."""
        bar = self._bars[job]
        fraction = min(1.0, done / bar.total) if bar.total else 1.0
        self._progress.update(bar.id, completed=fraction * bar.total, state=state)
        if self._logs and fraction >= bar.logged + self._log_every:
            bar.logged = fraction
            log_line(f"{bar.name}: {fraction:.0%}" + (f", {state}" if state else ""))

    def stop(self, job: Hashable) -> None:
        """Stop the clock of a job's bar."""
        self._progress.stop_task(self._bars[job].id)

    def remove(self, job: Hashable) -> None:
        """Remove a job's bar."""
        self._progress.remove_task(self._bars.pop(job).id)


@dataclass(slots=True)
class _Bar:
    name: str
    total: float
    id: TaskID
    #: fraction of the job at the last logged line
    logged: float


def _finite(value: object) -> object:
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return value
