"""The whole training loop without human labellers, by `accord demo` and `accord teach`."""

import json
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

from acceptance.accord_service import ENVIRONMENT, TINY, TINY_POLICY, Accord, Client
from mapt.training.metrics import read_metrics
from mapt.training.results import RunResult, find_runs
from mapt.training.settings import PreferenceRewardSettings
from support.waiting import PATIENCE_SECONDS, until


def test_demo_runs_the_whole_loop_and_writes_runs_figure_and_table(tmp_path: Path) -> None:
    output = tmp_path / "out"
    options = ["--steps", "10000", "--labels", "24", "--seeds", "3", "--output", str(output)]
    done = subprocess.run(
        [sys.executable, "-m", "accord.cli", "demo", *options],
        env=os.environ | ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_SECONDS,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for heading in ("untrained", "learned", "share", "labels", "versions"):
        assert heading in done.stdout
    folders = find_runs([output])
    runs = [RunResult.read(folder) for folder in folders]
    learned, baseline = sorted(runs, key=lambda run: run.settings.reward is None)
    assert baseline.settings.reward is None
    assert learned.settings.reward == PreferenceRewardSettings("MAPT", 24, 4, 2, "oracle")
    for run in (baseline, learned):
        assert run.settings.policy.seed == 3
        assert run.steps >= 10_000
        assert [one.steps for one in run.evaluations] == [0, run.steps]
    assert baseline.evaluations[0].mean == learned.evaluations[0].mean, "the same seed gives the same untrained policy"
    [folder] = [folder for folder in folders if "MAPT" in folder.path.name]
    last = read_metrics(folder.metrics)[-1]
    assert last["labels"] == 24
    assert {"learned_return", "reward_version"} <= set(last)
    assert (output / "returns.png").read_bytes().startswith(b"\x89PNG")
    assert "| MAPT, 24 labels |" in (output / "returns.md").read_text()

    evaluated = subprocess.run(
        [sys.executable, "-m", "mapt.cli", "evaluate", str(folder.path), "--seed", "3", "--json"],
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE_SECONDS,
    )
    stored = folder.read_evaluation(learned.steps)
    assert stored is not None
    assert json.loads(evaluated.stdout)["returns"] == list(stored.returns)


def test_a_killed_demo_resumes_with_every_label(tmp_path: Path) -> None:
    output = tmp_path / "out"
    policy = [argument for name, value in TINY_POLICY.items() for argument in ("--set", f"{name}={value}")]
    command = [
        *(sys.executable, "-m", "accord.cli", "demo", "--task", TINY["task"], "--no-baseline", "--steps", "4000"),
        *(
            "--labels",
            "12",
            "--models",
            "MA-MLP,MAPT-paper",
            "--workers",
            "2",
            "--json",
            "--output",
            str(output),
            *policy,
        ),
    ]
    database = output / "home" / "accord.db"
    process = subprocess.Popen(command, env=os.environ | ENVIRONMENT, stdout=subprocess.DEVNULL)
    until(lambda: process.poll() is not None or labels_in(database), "the first label")
    assert process.poll() is None
    process.kill()
    process.wait()
    before = labels_in(database)

    done = subprocess.run(command, env=os.environ | ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads(done.stdout)
    assert [(row["reward_model"], row["labels"]) for row in rows] == [("MA-MLP", 12), ("MAPT-paper", 12)]
    assert len(find_runs([output])) == 2
    assert before <= labels_in(database)
    assert len(labels_in(database)) == 24

    more = [*command, "--steps", "5000"]
    refused = subprocess.run(more, env=os.environ | ENVIRONMENT, capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert "total_steps is 4000, not 5000" in refused.stderr


def labels_in(database: Path) -> set[str]:
    """Ids of the stored labels. Empty before the table exists."""
    if not database.exists():
        return set()
    with closing(sqlite3.connect(database)) as connection:
        if not connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'labels'").fetchone():
            return set()
        return {id for (id,) in connection.execute("SELECT id FROM labels")}


def test_teach_labels_over_the_rest_api_until_the_budget_is_spent(accord: Accord) -> None:
    accord.start()
    client = Client(accord, accord.token("ada", "researcher"))
    id = client.create_experiment(total_steps=1000, render_clips=False)
    token = accord.token("oracle", "teacher")
    done = accord.run("teach", "--experiment", id, "--token", token)
    assert done.returncode == 0, done.stderr
    assert f"{TINY['label_budget']} labels given" in done.stdout
    until(lambda: client.experiment(id)["status"] == "finished", "the experiment finishes")
    wrong = """
        SELECT count(*) FROM labels JOIN queries ON queries.id = query_id
        JOIN segments a ON a.id = segment_0_id JOIN segments b ON b.id = segment_1_id
        WHERE labels.value != CASE WHEN a.true_return > b.true_return THEN 1.0 ELSE 0.0 END
    """
    assert accord.rows(wrong) == [(0,)]


def test_teach_prints_errors_in_one_line(accord: Accord) -> None:
    accord.start()
    token = accord.token("grace", "labeller")
    client = Client(accord, accord.token("ada", "researcher"))
    id = client.create_experiment()
    for arguments, message in (
        (("--experiment", id, "--token", "wrong"), "token is wrong"),
        (("--experiment", id, "--token", token), "never for labellers"),
        (("--experiment", "exp_" + "0" * 24, "--token", token), "There is no experiment"),
        (("--experiment", id, "--token", token, "--teacher", "nobody"), "No teacher is called"),
        (("--experiment", id, "--token", token, "--teacher", "oracle:mistake=2"), "mistake"),
    ):
        done = accord.run("teach", *arguments)
        assert done.returncode == 2
        assert message in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
