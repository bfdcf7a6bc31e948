"""The `mapt` command."""

from mapt.cli.main import main

__all__ = ["main"]
