"""The command `accord`."""

from accord.cli.main import main

__all__ = ["main"]
