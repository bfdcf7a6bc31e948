"""Runs the scripts in docs/examples."""

import subprocess
import sys
from pathlib import Path

from mapt.training.results import RunResult
from mapt.training.run_folder import RunFolder

DOCS = Path(__file__).parents[3] / "docs"
EXAMPLES = DOCS / "examples"


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


def test_the_example_of_the_library_trains_a_policy(tmp_path):
    code = (DOCS / "library.md").read_text().partition("```python\n")[2].partition("```")[0]
    assert len(code.split("import mapt\n")[1].split("\n\n")[0].strip().splitlines()) <= 8
    small = code.replace("pairs=300", "pairs=12").replace("1_000_000", "800").replace('"MAPT"', '"MA-MLP"')
    assert small.count("12") == small.count("800") == 1
    done = subprocess.run([sys.executable, "-c", small], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "over 32 episodes of 1,000 steps" in done.stdout
    assert (tmp_path / "reward" / "reward.json").is_file()
    assert (tmp_path / "policy.safetensors").is_file()
