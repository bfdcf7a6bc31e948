"""The home folder is private, also when an earlier version created it."""

import stat
from pathlib import Path

from accord.store.home import make_private


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def old_home(path: Path) -> Path:
    """A home folder that everybody may read."""
    for folder in (path, path / "blobs", path / "logs"):
        folder.mkdir(exist_ok=True)
        folder.chmod(0o755)
    (path / "accord.db").touch(0o644)
    return path


def test_what_an_earlier_version_left_readable_becomes_private(tmp_path: Path) -> None:
    home = old_home(tmp_path / "home")
    make_private(home)
    assert [mode(home / name) for name in ("", "blobs", "logs", "accord.db")] == [0o700, 0o700, 0o700, 0o600]


def test_a_folder_that_others_use_too_stays_open(tmp_path: Path) -> None:
    home = old_home(tmp_path / "shared")
    home.chmod(0o1777)
    make_private(home)
    assert (mode(home), mode(home / "accord.db")) == (0o1777, 0o600)
