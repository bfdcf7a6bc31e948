"""The whole loop without a person, by the commands that people use."""

import csv
import json
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

from acceptance.accord_service import ENVIRONMENT, TINY, TINY_POLICY, Accord, Person
from support.waiting import PATIENCE_SECONDS, until


def test_demo_runs_the_whole_loop_and_leaves_table_curves_and_plot(tmp_path: Path) -> None:
    output = tmp_path / "out"
    options = ["--steps", "10000", "--labels", "24", "--seed", "3", "--output", str(output)]
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
    baseline, learned = json.loads((output / "results.json").read_text())["runs"]
    assert [run["plan"]["reward_source"] for run in (baseline, learned)] == ["true", "preferences"]
    assert baseline["untrained"] == learned["untrained"], "one seed, one untrained policy"
    assert learned["labels"] == 24
    assert (baseline["teacher"], learned["teacher"]["name"], learned["teacher"]["seed"]) == ({}, "oracle", 3)
    assert learned["versions"][-1]["label_count"] == 24
    assert learned["steps"] >= 10_000
    with (output / "curves.csv").open() as file:
        assert {"learned_return"} <= {row["curve"] for row in csv.DictReader(file)}
    assert (output / "returns.png").read_bytes().startswith(b"\x89PNG")


def test_a_demo_that_was_killed_goes_on_with_every_label(tmp_path: Path) -> None:
    output = tmp_path / "out"
    policy = [word for name, value in TINY_POLICY.items() for word in ("--set", f"{name}={value}")]
    command = [
        *(sys.executable, "-m", "accord.cli", "demo", "--task", TINY["task"], "--no-baseline", "--steps", "4000"),
        *("--labels", "12,24", "--reward-model", "MA-MLP", "--at-once", "2", "--output", str(output), *policy),
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
    runs = json.loads((output / "results.json").read_text())["runs"]
    assert [(run["plan"]["label_budget"], run["labels"]) for run in runs] == [(12, 12), (24, 24)]
    assert before <= labels_in(database)
    assert len(labels_in(database)) == 36

    more = [*command, "--steps", "5000"]
    refused = subprocess.run(more, env=os.environ | ENVIRONMENT, capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert "total_steps is 4000, not 5000" in refused.stderr


def labels_in(database: Path) -> set[str]:
    """Ids of the labels; none before the table is made."""
    if not database.exists():
        return set()
    with closing(sqlite3.connect(database)) as connection:
        if not connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'labels'").fetchone():
            return set()
        return {id for (id,) in connection.execute("SELECT id FROM labels")}


def test_teach_labels_until_the_budget_is_met_through_rest_alone(accord: Accord) -> None:
    accord.start()
    person = Person(accord, accord.token("ada", "researcher"))
    id = person.begin(total_steps=1000, render_clips=False)
    token = accord.token("oracle", "teacher")
    done = accord.run("teach", "--experiment", id, "--token", token)
    assert done.returncode == 0, done.stderr
    assert f"{TINY['label_budget']} labels given" in done.stdout
    until(lambda: person.experiment(id)["status"] == "finished", "the experiment finishes")
    wrong = """
        SELECT count(*) FROM labels JOIN queries ON queries.id = query_id
        JOIN segments a ON a.id = segment_0_id JOIN segments b ON b.id = segment_1_id
        WHERE labels.value != CASE WHEN a.true_return > b.true_return THEN 1.0 ELSE 0.0 END
    """
    assert accord.rows(wrong) == [(0,)]


def test_teach_says_in_a_sentence_what_was_wrong(accord: Accord) -> None:
    accord.start()
    token = accord.token("grace", "labeller")
    person = Person(accord, accord.token("ada", "researcher"))
    id = person.begin()
    for arguments, words in (
        (("--experiment", id, "--token", "wrong"), "token is wrong"),
        (("--experiment", id, "--token", token), "never for labellers"),
        (("--experiment", "exp_" + "0" * 24, "--token", token), "There is no experiment"),
        (("--experiment", id, "--token", token, "--teacher", "nobody"), "no teacher is called"),
        (("--experiment", id, "--token", token, "--parameter", "mistake=2"), "mistake must lie in"),
    ):
        done = accord.run("teach", *arguments)
        assert done.returncode == 2
        assert words in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
