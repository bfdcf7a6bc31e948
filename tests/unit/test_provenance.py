"""Where a result comes from, told by repositories and task files of a test."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

import mapt
from mapt.provenance import provenance
from mapt.rewards.checkpoints import load_reward_model, save_reward_model
from mapt.rewards.config import RewardConfig
from mapt.rewards.registry import build_reward_model
from mapt.training.reward_source import save_version


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=Ada", "-c", "user.email=ada@example.org")
    done = subprocess.run(["git", "-C", folder, *identity, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def provenance_in(folder: Path, **environment: str) -> dict[str, Any]:
    """The provenance that a process tells whose `mapt` is the copy in `folder`."""
    script = "import json; from mapt.provenance import provenance; print(json.dumps(provenance()))"
    environment = {**os.environ, "PYTHONPATH": str(folder), **environment}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment)
    return json.loads(done.stdout)


def test_commit_of_a_clone_and_its_changes(tmp_path: Path) -> None:
    shutil.copytree(Path(mapt.__file__).parent, tmp_path / "mapt", ignore=shutil.ignore_patterns("__pycache__"))
    git(tmp_path, "init", "--quiet")
    # The folder is inside a repository that does not track it, as an environment in a user's repository is.
    assert (provenance_in(tmp_path)["commit"], provenance_in(tmp_path)["dirty"]) == (None, None)

    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    clean = provenance_in(tmp_path)
    assert (clean["commit"], clean["dirty"]) == (git(tmp_path, "rev-parse", "HEAD"), False)

    with (tmp_path / "mapt" / "io.py").open("a") as file:
        file.write("# changed\n")
    assert provenance_in(tmp_path)["dirty"] is True


def test_versions_device_and_task_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = tmp_path / "tug.py"
    task.write_text("# a task\n")
    monkeypatch.setenv("MAPT_TASKS", os.pathsep.join((str(task), "json", str(tmp_path / "missing.py"))))
    found = provenance("cuda:1", 3)
    assert (found["device"], found["threads"]) == ("cuda:1", 3)
    assert found["accord"] == version("accord")
    assert found["mujoco"] == version("mujoco")
    assert found["task_files"] == {
        str(task): hashlib.sha256(b"# a task\n").hexdigest(),
        "json": hashlib.sha256(Path(str(json.__file__)).read_bytes()).hexdigest(),
        str(tmp_path / "missing.py"): None,
    }


def test_a_copy_of_a_reward_model_keeps_the_provenance_of_its_training(tmp_path: Path) -> None:
    model = build_reward_model(
        RewardConfig.preset("small", n_agents=2, observation_dim=3, action_dim=1, segment_steps=5)
    )
    saved = save_reward_model(model, {}, segment_steps=5, trained_by={"commit": "abc"})
    loaded = load_reward_model(saved.weights, saved.card)
    save_version(loaded, tmp_path)
    assert json.loads((tmp_path / "reward.json").read_text())["provenance"] == {"commit": "abc"}

    older = json.loads(saved.card)
    del older["provenance"]
    assert load_reward_model(saved.weights, json.dumps(older).encode()).provenance == {}
