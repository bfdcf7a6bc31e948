"""How commands print checks, and end."""

from collections.abc import Sequence
from dataclasses import asdict

import typer
from rich.markup import escape

from accord.domain.checks import Check
from mapt.cli.output import print_json, print_line


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
