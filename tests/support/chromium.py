"""The Chromium of this machine."""

import shutil

#: The first one that is there is used. The headless shell is the same browser without windows: tests take a quarter
#: less CPU time.
COMMANDS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")


def chromium() -> str | None:
    """The path of Chromium's program, or None."""
    return next((path for command in COMMANDS if (path := shutil.which(command))), None)
