"""One version: of the package, the commands, the API, the page, the citation and the changelog."""

import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def test_the_installed_package_has_the_version_of_the_project() -> None:
    assert version("accord") == VERSION


@pytest.mark.parametrize("command", ["accord", "mapt"])
def test_the_commands_print_it(command: str) -> None:
    line = [sys.executable, "-m", f"{command}.cli", "--version"]
    printed = subprocess.run(line, capture_output=True, text=True, check=True).stdout
    assert printed == f"{command} {VERSION}\n"


def test_the_api_and_the_page_have_it() -> None:
    assert json.loads((ROOT / "frontend" / "openapi.json").read_text())["info"]["version"] == VERSION
    assert json.loads((ROOT / "frontend" / "package.json").read_text())["version"] == VERSION


def test_the_citation_has_it() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == VERSION


def test_the_newest_entry_of_the_changelog_is_about_it() -> None:
    versions = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == VERSION


@pytest.mark.slow
def test_a_wheel_and_what_is_installed_from_it_have_it(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", tmp_path, ROOT], check=True)
    wheel = tmp_path / f"accord-{VERSION}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as file:
        metadata = file.read(f"accord-{VERSION}.dist-info/METADATA").decode()
        assert "accord/static/index.html" in file.namelist()
    assert f"\nVersion: {VERSION}\n" in metadata

    installed = tmp_path / "installed"
    subprocess.run([*pip, "install", "--no-deps", "--target", installed, wheel], check=True)

    def run(*line: str) -> str:
        environment = os.environ | {"PYTHONPATH": str(installed)}
        return subprocess.run(
            [sys.executable, *line], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        ).stdout

    assert run("-c", "import accord, mapt; print(accord.__file__, mapt.__file__)").count(str(installed)) == 2
    assert run("-m", "accord.cli", "--version") == f"accord {VERSION}\n"
    assert run("-m", "mapt.cli", "--version") == f"mapt {VERSION}\n"
    run("-m", "accord.api.openapi", "openapi.json")
    assert json.loads((tmp_path / "openapi.json").read_text())["info"]["version"] == VERSION
