"""The one command: mapt."""

from mapt.cli.main import main

__all__ = ["main"]
