"""A backup of a service that trains and takes labels, restored into another home folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from acceptance.accord_service import ENVIRONMENT, STEPS_PER_ITERATION, Accord, Client
from support.waiting import until

pytestmark = pytest.mark.slow


def test_a_restored_experiment_keeps_its_labels_and_trains_on(accord: Accord, tmp_path: Path) -> None:
    accord.start(without=("render", "child"))
    token = accord.token("ada", "researcher")
    client = Client(accord, token)
    id = client.create_experiment(label_budget=24, total_steps=24 * STEPS_PER_ITERATION, render_clips=False)
    acknowledged: dict[str, float] = {}

    def label() -> None:
        if client.experiment(id)["status"] == "running":
            acknowledged.update(client.label_some(id, 2))

    def has_checkpoint() -> bool:
        label()
        return bool(accord.rows("SELECT 1 FROM policy_checkpoints"))

    until(has_checkpoint, "the policy has a checkpoint")
    before = dict(acknowledged)
    backup = tmp_path / "backup"
    command = [sys.executable, "-m", "accord.cli", "backup", str(backup), "--home", str(accord.home)]
    with subprocess.Popen(command, env=os.environ | ENVIRONMENT, stdout=subprocess.PIPE, text=True) as running:

        def ended() -> bool:
            label()
            return running.poll() is not None

        until(ended, "the backup ends")
        assert running.returncode == 0, running.communicate()
    accord.kill_everything()

    (tmp_path / "other").mkdir()
    other = Accord(tmp_path / "other" / "home")
    try:
        restored = other.run("restore", str(backup))
        assert restored.returncode == 0, restored.stdout + restored.stderr
        assert other.run("restore", str(backup)).returncode == 2
        stored = dict(other.rows("SELECT query_id, value FROM labels"))
        assert {query: stored.get(query) for query in before} == before
        [(steps,)] = other.rows("SELECT max(steps) FROM policy_checkpoints")
        assert steps > 0, steps
        other.start(without=("render", "child"))
        client = Client(other, token)
        assert client.experiment(id)["steps"] >= steps

        def finished() -> bool:
            client.label_some(id)
            experiment = client.experiment(id)
            assert experiment["status"] in {"running", "finished"}, experiment["phase_detail"]
            return experiment["status"] == "finished"

        until(finished, "the restored experiment finishes")
        for command in (["prune", "--delete"], ["verify"]):
            done = other.run(*command)
            assert done.returncode == 0, done.stdout + done.stderr
    finally:
        other.kill_everything()
