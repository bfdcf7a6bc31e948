"""Runs the scripts in docs/examples."""

import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"


def test_the_preference_loop_trains_from_an_oracle_without_a_server():
    script = EXAMPLES / "preference_loop.py"
    assert len(script.read_text().splitlines()) <= 40
    # The first episodes, of 1,000 steps each, end in the eighth of nine iterations.
    done = subprocess.run([sys.executable, script, "9000", "10"], capture_output=True, text=True, check=True)
    last = done.stdout.splitlines()[-1]
    assert "10 labels" in last
    assert "true return" in last
