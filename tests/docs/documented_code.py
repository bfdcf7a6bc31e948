"""Runs code of the documentation with smaller numbers."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

#: What the documentation writes, and with what its code takes seconds.
SMALLER = {
    "total_steps=500_000": "total_steps=1_600, initial_labels=4, segment_steps=10, "
    "lookahead_queries=1, "
    "policy={'n_envs': 4, 'rollout_steps': 100, 'minibatches': 2}",
    "label_budget=200": "label_budget=8",
    "steps=1_000_000": "steps=800",
    "steps=500_000": "steps=800",
    "LabelSchedule(300, initial=100,": "LabelSchedule(12, initial=4,",
    "pairs=300": "pairs=12",
    "100_000, 500,": "2_000, 12,",
    "range(10_000)": "range(10)",
    "n_pairs=4_000": "n_pairs=20",
    "segments=2_000": "segments=24",
    '"MAPT"': '"MA-MLP"',
    "hidden_dim=128, layers=2": "hidden_dim=32",
}
#: where the documentation's service is
URL = "http://127.0.0.1:8000"


def run_code(
    code: str,
    folder: Path,
    *arguments: str,
    url: str = "",
    token: str = "",
    environment: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Run Python code in a folder, in a process of its own; returns what it prints.

    Args:
        url, token: of a service.
        environment: further variables.
    """
    for written, small in SMALLER.items():
        code = code.replace(written, small)
    (folder / "documented.py").write_text(code.replace(URL, url))
    done = subprocess.run(
        [sys.executable, "documented.py", *arguments],
        cwd=folder,
        env=os.environ | {"ACCORD_TOKEN": token, "MPLBACKEND": "agg"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
