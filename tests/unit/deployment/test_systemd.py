"""The units of systemd in docs/deploy."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parents[3] / "docs" / "deploy"
UNITS = [path.name for path in sorted(DEPLOY.iterdir()) if path.suffix in {".service", ".timer"}]
#: of 100, from the analysis of systemd: a unit without any protection has 96
MOST_EXPOSURE = 25
pytestmark = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd-analyze is not installed")


@pytest.fixture
def units(tmp_path: Path) -> Path:
    """The units, with this environment's command `accord`, because the analysis wants one that exists."""
    for name in UNITS:
        text = (DEPLOY / name).read_text().replace("/opt/accord/.venv/bin", str(Path(sys.executable).parent))
        (tmp_path / name).write_text(text)
    return tmp_path


def test_units_are_valid(units: Path) -> None:
    paths = [str(units / name) for name in UNITS]
    done = subprocess.run(["systemd-analyze", "verify", *paths], capture_output=True, text=True, check=False)
    own = [line for line in done.stderr.splitlines() if "accord" in line]
    assert own == []


@pytest.mark.parametrize("name", [name for name in UNITS if name.endswith(".service")])
def test_services_are_confined(units: Path, name: str) -> None:
    command = ["systemd-analyze", "security", "--offline=true", f"--threshold={MOST_EXPOSURE}", str(units / name)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-300:]
