"""What the commands print: plain lines where the output is no terminal."""

import sys
from datetime import datetime

from rich.console import Console
from rich.markup import escape

#: what was asked for
out = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 100)
#: what went wrong
err = Console(stderr=True, highlight=False, soft_wrap=True)


def say(text: str) -> None:
    """A line of rich markup."""
    out.print(text)


def note(text: str) -> None:
    """A line of a long run: the time, and what. No markup."""
    now = datetime.now().astimezone().strftime("%H:%M:%S")
    out.print(f"[dim]{now}[/dim] {escape(text)}")


def complain(text: str) -> None:
    """An error: one sentence."""
    err.print(f"[bold red]mapt:[/bold red] {escape(text)}")


def on_terminal() -> bool:
    return sys.stdout.isatty()
