"""How far long work is: bars on a terminal; where there is none, a line now and then."""

from collections.abc import Hashable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

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
        self._bars: dict[Hashable, _Bar] = {}

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def begin(self, work: Hashable, name: str, total: float) -> None:
        self._bars[work] = _Bar(name, total, self._progress.add_task(name, total=total, state=""))

    def show(self, work: Hashable, done: float, state: str) -> None:
        """Say how much of a work is done, and in a few words what that is like."""
        bar = self._bars[work]
        share = min(1.0, done / bar.total)
        self._progress.update(bar.drawn, completed=share * bar.total, state=state)
        if not on_terminal() and share >= bar.noted + self._noted_share:
            bar.noted = share
            note(f"{bar.name}: {share:.0%}, {state}")

    def end(self, work: Hashable) -> None:
        self._progress.stop_task(self._bars[work].drawn)


@dataclass(slots=True)
class _Bar:
    name: str
    total: float
    drawn: TaskID
    #: share of the work that was last told of in a line
    noted: float = 0.0
