"""How the commands about stored data show their progress, print checks, and end."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict

import typer
from rich.markup import escape

from accord.domain.checks import Check
from accord.store.blobs import OnBlobs
from mapt.cli.output import ProgressBars, print_json, print_line


@contextmanager
def blob_progress(*, hidden: bool) -> Generator[OnBlobs]:
    """A progress bar, shown until the block ends. Yields the function that sets it.

    Args:
        hidden: draw and log nothing.
    """
    with ProgressBars(hidden=hidden) as bars:
        bars.add("blobs", "blobs", 1)
        yield lambda done, total: bars.update("blobs", done / total, f"{done}/{total}")


def finish(checks: Sequence[Check], *, as_json: bool) -> None:
    """Print the checks and end the command, with status 1 if one failed.

    Raises:
        typer.Exit: always.
    """
    if as_json:
        print_json([asdict(found) for found in checks])
    else:
        for found in checks:
            print_check(found)
        failed = sum(not found.ok for found in checks)
        print_line(f"{len(checks) - failed} of {len(checks)} checks passed.")
    raise typer.Exit(0 if all(found.ok for found in checks) else 1)


def print_check(found: Check) -> None:
    """Print a check, and how to fix it if it failed."""
    mark = "[green]ok[/green]    " if found.ok else "[bold red]failed[/bold red]"
    print_line(f"{mark} {escape(found.name)}: {escape(found.detail)}")
    if found.fix:
        print_line(f"       fix: {escape(found.fix)}")
