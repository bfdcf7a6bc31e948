"""The whole training loop without human labellers, by `accord demo` and `accord teach`."""

import json
import os
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import av
import pytest

from acceptance.accord_service import ENVIRONMENT, TINY, TINY_POLICY, Accord, Client
from accord.cli.demo_versions import read_reports
from mapt.training.metrics import read_metrics
from mapt.training.results import RunResult, find_runs
from mapt.training.settings import PreferenceRewardSettings
from support import short_tasks
from support.mapt_command import CommandResult
from support.waiting import PATIENCE_SECONDS, until

pytestmark = pytest.mark.slow

STEPS = 2000


def test_a_killed_demo_resumes_with_every_label_and_writes_runs_scores_videos_figure_and_table(
    tmp_path: Path, mapt: Callable[..., CommandResult], short_episodes: None
) -> None:
    output = tmp_path / "out"
    policy = [argument for name, value in TINY_POLICY.items() for argument in ("--set", f"{name}={value}")]
    command = [
        *("demo", "--task", TINY["task"], "--steps", str(STEPS), "--models", "MA-MLP,MAPT-paper"),
        *("--teacher", "phase", "--labels", "12", "--labels-per-version", "5", "--seeds", "3", "--video", "--json"),
        *("--output", str(output), *policy),
    ]
    database = output / "home" / "accord.db"
    process = subprocess.Popen(
        [sys.executable, "-m", "accord.cli", *command, "--workers", "1"],
        env=os.environ | ENVIRONMENT,
        stdout=subprocess.DEVNULL,
    )
    until(lambda: process.poll() is not None or labels_in(database), "the first label")
    assert process.poll() is None
    process.kill()
    process.wait()
    before = labels_in(database)

    resumed = subprocess.run(
        [sys.executable, "-m", "accord.cli", *command, "--workers", "2"],
        env=os.environ | ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_SECONDS,
    )
    assert resumed.returncode == 0, resumed.stdout + resumed.stderr
    rows = json.loads(resumed.stdout)
    assert [(row["reward_model"], row["labels"]) for row in rows] == [("MA-MLP", 12), ("MAPT-paper", 12)]
    assert before <= labels_in(database)
    assert len(labels_in(database)) == 24

    folders = find_runs([output])
    runs = {run.settings.reward: run for run in (RunResult.read(folder) for folder in folders)}
    learned = [PreferenceRewardSettings(model, 12, 2, 5, "phase") for model in ("MA-MLP", "MAPT-paper")]
    assert runs.keys() == {None, *learned}
    for run in runs.values():
        assert run.settings.policy.seed == 3
        assert run.steps >= STEPS
        assert [one.steps for one in run.evaluations] == [0, run.steps]
    untrained = {run.evaluations[0].mean for run in runs.values()}
    assert len(untrained) == 1, "the same seed gives the same untrained policy"
    [folder] = [folder for folder in folders if "MAPT-paper" in folder.path.name]
    last = read_metrics(folder.metrics)[-1]
    assert last["labels"] == 12
    assert {"learned_return", "reward_version"} <= set(last)
    versions = read_reports(folder.path / "versions.csv")
    assert (versions[-1].labels, versions[-1].fresh_pairs > 0) == (12, True)
    assert rows[1]["fresh_accuracy"] == versions[-1].fresh_accuracy
    assert (output / "returns.png").read_bytes().startswith(b"\x89PNG")
    assert "| MA-MLP, 12 labels |" in (output / "returns.md").read_text()

    scores = {run.settings.reward: run.teacher_scores["phase"] for run in runs.values()}
    untrained_scores = {tuple(each.untrained) for each in scores.values()}
    assert len(untrained_scores) == 1
    for row, settings in zip(rows, learned, strict=True):
        assert row["teacher_learned_reward"] == pytest.approx(scores[settings].final.mean())
        assert row["teacher_true_reward"] == pytest.approx(scores[None].final.mean())
        assert 0 <= row["preferred_to_true_reward"] <= 1
    assert "score by the teacher `phase`" in (output / "returns.md").read_text()
    for each in folders:
        with av.open(str(each.video)) as container:
            assert container.streams.video[0].frames == short_tasks.HORIZON_STEPS

    evaluated = mapt("evaluate", folder.path, "--seed", "3", "--json")
    stored = folder.read_evaluation(runs[learned[1]].steps)
    assert stored is not None
    assert json.loads(evaluated.printed)["returns"] == list(stored.returns)


def labels_in(database: Path) -> set[str]:
    """Ids of the stored labels. Empty before the table exists."""
    if not database.exists():
        return set()
    with closing(sqlite3.connect(database)) as connection:
        if not connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'labels'").fetchone():
            return set()
        return {id for (id,) in connection.execute("SELECT id FROM labels")}


@dataclass(frozen=True, slots=True)
class RunningService:
    """A service with an experiment."""

    accord: Accord
    #: with a researcher's token
    client: Client
    experiment_id: str

    def teach(self, token: str, *options: str) -> subprocess.CompletedProcess[str]:
        return self.accord.run("teach", "--experiment", self.experiment_id, "--token", token, *options)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    """Shared by the tests of `accord teach`: the first gives no label, the second all."""
    accord = Accord(tmp_path_factory.mktemp("teach") / "home")
    accord.start(without=["render"])
    client = Client(accord, accord.token("ada", "researcher"))
    yield RunningService(accord, client, client.create_experiment(total_steps=1000, render_clips=False))
    accord.kill_everything()


def test_teach_prints_errors_in_one_line(running: RunningService) -> None:
    token = running.accord.token("grace", "labeller")
    for options, message in (
        (("--token", "wrong"), "token is wrong"),
        ((), "never for labellers"),
        (("--experiment", "exp_" + "0" * 24), "There is no experiment"),
        (("--teacher", "nobody"), "No teacher is called"),
        (("--teacher", "oracle:mistake=2"), "mistake"),
    ):
        done = running.teach(token, *options)
        assert done.returncode == 2
        assert message in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1


def test_teach_labels_over_the_rest_api_until_the_budget_is_spent(running: RunningService) -> None:
    added = running.accord.run("user", "add", "oracle", "--role", "teacher")
    done = running.teach(dict(line.split() for line in added.stdout.splitlines())["token"])
    assert done.returncode == 0, done.stderr
    assert f"{TINY['label_budget']} labels given" in done.stdout
    experiment = running.experiment_id
    until(lambda: running.client.experiment(experiment)["status"] == "finished", "the experiment finishes")
    wrong = """
        SELECT count(*) FROM labels JOIN queries ON queries.id = query_id
        JOIN segments a ON a.id = segment_0_id JOIN segments b ON b.id = segment_1_id
        WHERE labels.value != CASE WHEN a.true_return > b.true_return THEN 1.0 ELSE 0.0 END
    """
    assert running.accord.rows(wrong) == [(0,)]
