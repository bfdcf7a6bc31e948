"""Where a result comes from: the versions, the commit, the task files and the device that made it."""

import hashlib
import json
import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution, version
from importlib.util import find_spec
from pathlib import Path

from mapt.tasks.registry import task_files

#: distributions whose versions change results
_PACKAGES = ("mujoco", "numpy", "torch")
_GIT_SECONDS = 5.0


def provenance(device: str = "cpu", threads: int | None = None) -> dict[str, object]:
    """What a result depends on besides its settings, as JSON-ready values.

    Keys: `accord`, `mujoco`, `numpy`, `python` and `torch` are versions. `commit` is the git commit of the code, None
    if it is not known; `dirty` is whether tracked files differ from it. `task_files` has the SHA-256 of each file or
    module that MAPT_TASKS names, None for one that cannot be read. `machine` is the kind of processor, `device` and
    `threads` what torch computed on.

    Args:
        device: name of the torch device.
        threads: torch's threads; None if nothing was computed.
    """
    commit, dirty = _commit()
    return {
        "accord": version("accord"),
        "commit": commit,
        "dirty": dirty,
        "python": platform.python_version(),
        **{name: version(name) for name in _PACKAGES},
        "task_files": {name: _sha256(name) for name in task_files()},
        "machine": platform.machine(),
        "device": device,
        "threads": threads,
    }


@cache
def _commit() -> tuple[str | None, bool | None]:
    """The commit of this package's code, and whether its files differ from it; None where it is not known.

    A clone knows it from git, an installation from a git URL from the file that pip wrote (PEP 610).
    """
    here = Path(__file__).parent
    # In an environment inside somebody else's repository, git would name the commit of that one.
    if _git(here, "ls-files", "--error-unmatch", Path(__file__).name) is not None:
        commit, changes = _git(here, "rev-parse", "HEAD"), _git(here, "status", "--porcelain", "--untracked-files=no")
        return commit, None if changes is None else bool(changes)
    try:
        origin = json.loads(distribution("accord").read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        return None, None
    commit = origin.get("vcs_info", {}).get("commit_id")
    return commit, None if commit is None else False


def _git(folder: Path, *arguments: str) -> str | None:
    """What git prints; None if it fails or is not installed."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True, timeout=_GIT_SECONDS
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _sha256(name: str) -> str | None:
    """SHA-256 of a Python file, or of the file of a module."""
    path = Path(name)
    if path.suffix != ".py":
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            return None
        path = Path(spec.origin)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None
