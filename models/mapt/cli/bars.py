"""How far long work is: bars on a terminal; where there is none, a line now and then."""

from types import TracebackType
from typing import Self

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mapt.cli.output import note, on_terminal, out


class Bars:
    """A bar for each of several works, as they begin.

    Args:
        noted_share: without a terminal, a line each time so much more of a work is done.
    """

    def __init__(self, noted_share: float) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"))
        self._progress = Progress(
            *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=out, disable=not on_terminal()
        )
        self._noted_share = noted_share

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def begin(self, name: str, total: float) -> "Bar":
        return Bar(name, total, self._progress, self._noted_share)


class Bar:
    """How far one work is; made by `Bars.begin`."""

    def __init__(self, name: str, total: float, progress: Progress, noted_share: float) -> None:
        self._name, self._total, self._progress, self._noted_share = name, total, progress, noted_share
        self._bar = progress.add_task(name, total=total, state="")
        self._noted = 0.0

    def show(self, done: float, state: str) -> None:
        """Say how much is done, and in a few words what that is like."""
        share = min(1.0, done / self._total)
        self._progress.update(self._bar, completed=share * self._total, state=state)
        if not on_terminal() and share >= self._noted + self._noted_share:
            self._noted = share
            note(f"{self._name}: {share:.0%}, {state}")

    def end(self) -> None:
        self._progress.stop_task(self._bar)
