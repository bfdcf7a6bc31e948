"""Keeps the home folder private: its files are readable by its user only (0600), its folders (0700)."""

import os
from contextlib import suppress
from pathlib import Path

_FILE, _FOLDER = 0o600, 0o700
#: what Accord keeps in a home folder; the contents of a private folder are out of reach whatever their modes
_FILES = ("accord.db", "accord.db-wal", "accord.db-shm", "url", "lock")
_FOLDERS = ("blobs", "logs")


def keep_new_files_private() -> None:
    """Makes this process, and those that it starts, create files and folders for their user only."""
    os.umask(0o077)


def make_private(home: Path) -> None:
    """Changes what an earlier version left readable for others in a home folder.

    The folder itself is changed unless others use it too: a shared one, such as /tmp, is sticky.
    """
    modes = {home / name: _FILE for name in _FILES} | {home / name: _FOLDER for name in _FOLDERS}
    if not home.stat().st_mode & 0o1000:
        modes[home] = _FOLDER
    for path, mode in modes.items():
        # A file may not exist yet, and a folder of another user keeps its mode.
        with suppress(OSError):
            if path.stat().st_mode & 0o077:
                path.chmod(mode)
