import json
import math
from dataclasses import replace
from pathlib import Path

from accord.cli.results import rows_of, write
from accord.cli.runs import RunPlan, RunResult


def result(seed: int, source: str, final: float) -> RunResult:
    plan = RunPlan(f"{source} {seed}", "HalfCheetah-6x1", source, seed, 1000, 50, 10, 5, False)
    versions = [{"number": 1, "policy_steps": 0, "label_count": 10, "metrics": {}}] if source != "true" else []
    curves = {"true_return": [[500, final / 2], [1000, final]]}
    return RunResult(plan, "exp_1", 60.0, 1000, 50 if versions else 0, -5.0, final, 3.0, curves, versions)


def test_each_seed_is_compared_with_its_own_baseline_and_the_means_come_last():
    runs = [result(0, "true", 100.0), result(0, "preferences", 80.0), result(1, "true", 300.0)]
    rows = rows_of([*runs, result(1, "preferences", 150.0)])
    assert [(row.seed, row.share) for row in rows] == [("0", 0.8), ("1", 0.5), ("mean", 115 / 200)]
    assert rows[0].untrained == -5.0


def test_there_is_no_share_of_a_return_that_is_not_positive_or_not_known():
    assert math.isnan(rows_of([result(0, "true", -1.0), result(0, "preferences", 5.0)])[0].share)
    assert math.isnan(rows_of([result(0, "preferences", 5.0)])[0].share)


def test_results_are_written_as_json_csv_and_a_picture(tmp_path: Path):
    paths = write(tmp_path / "out", [result(0, "true", 100.0), result(0, "preferences", 80.0)])
    assert [path.name for path in paths] == ["results.json", "curves.csv", "returns.png"]
    assert json.loads(paths[0].read_text())["runs"][1]["final"] == 80.0
    assert paths[1].read_text().splitlines()[1] == "0,true,true_return,500,50.0"
    assert paths[2].stat().st_size > 10_000


def test_a_run_without_an_ended_episode_can_be_drawn(tmp_path: Path):
    bare = replace(result(0, "preferences", 80.0), curves={})
    assert write(tmp_path, [bare])[2].exists()
