"""One version: of the package, the commands, the API, the page, the citation and the changelog."""

import json
import re
import subprocess
import sys
import tomllib
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
