"""Runs the scripts in docs/examples."""

import subprocess
import sys
from pathlib import Path

from mapt.training.results import RunResult
from mapt.training.run_folder import RunFolder

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"


def test_the_preference_loop_trains_from_an_oracle_without_a_server(tmp_path):
    script = EXAMPLES / "preference_loop.py"
    assert len(script.read_text().splitlines()) <= 40
    # The first episodes, of 1,000 steps each, end in the eighth of nine iterations.
    command = [sys.executable, script, "9000", "10", tmp_path / "run"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    last = done.stdout.splitlines()[-1]
    assert "10 labels" in last
    assert "true return" in last
    found = RunResult.read(RunFolder(tmp_path / "run"))
    assert found.steps == found.evaluations[-1].steps >= 9000
