import json
import math
from dataclasses import asdict, replace
from pathlib import Path

from matplotlib.image import imread

from accord.cli.demo_runs import Grid, RunPlan, RunResult
from accord.cli.results import rows_of, write


def result(seed: int, source: str, final: float, model: str = "MAPT", labels: int = 50) -> RunResult:
    plan = RunPlan(f"{source} {seed}", "HalfCheetah-6x1", source, seed, 1000, labels, 10, 5, False, model)
    versions = [{"number": 1, "policy_steps": 0, "label_count": 10, "metrics": {}}] if source != "true" else []
    curves = {"true_return": [[500, final / 2], [1000, final]]}
    return RunResult(plan, "exp_1", 60.0, 1000, 50 if versions else 0, -5.0, final, 3.0, curves, versions)


def test_each_seed_is_compared_with_its_own_baseline_and_the_means_come_last():
    runs = [result(0, "true", 100.0), result(0, "preferences", 80.0), result(1, "true", 300.0)]
    rows = rows_of([*runs, result(1, "preferences", 150.0)])
    assert [(row.seed, row.share) for row in rows] == [("0", 0.8), ("1", 0.5), ("mean", 115 / 200)]
    assert rows[0].untrained == -5.0


def test_seeds_of_one_model_and_number_of_labels_stand_together():
    runs = [
        result(0, "preferences", 80.0),
        result(0, "preferences", 70.0, "MA-MLP"),
        result(0, "preferences", 90.0, labels=99),
    ]
    rows = rows_of([*runs, result(1, "preferences", 60.0)])
    found = [(row.reward_model, row.seed, row.learned_reward) for row in rows]
    assert found == [
        ("MA-MLP", "0", 70.0),
        ("MAPT", "0", 80.0),
        ("MAPT", "1", 60.0),
        ("MAPT", "mean", 70.0),
        ("MAPT", "0", 90.0),
    ]
    assert rows[3].spread == 200**0.5


def test_lists_make_a_run_of_each_combination_and_one_of_the_true_reward_for_each_seed():
    grid = Grid("HalfCheetah-6x1", 1000, seeds=(0, 1), labels=(50, 100), reward_models=("MAPT", "MA-MLP"))
    plans = grid.plans("oracle")
    assert len({plan.name for plan in plans}) == len(plans) == 2 * (1 + 2 * 2)
    assert [plan.reward_source for plan in plans[:2]] == ["true", "preferences"]
    assert {(plan.label_budget, plan.initial_labels, plan.labels_per_version) for plan in plans[1:5]} == {
        (50, 10, 5),
        (100, 20, 10),
    }


def test_the_untrained_team_gets_few_of_many_labels():
    [plan] = Grid("HalfCheetah-6x1", 1000, (0,), (3000,), ("MAPT",), baseline=False).plans("oracle")
    assert (plan.initial_labels, plan.labels_per_version) == (100, 300)


def test_a_plan_tells_in_what_an_experiment_differs():
    [plan] = Grid("HalfCheetah-6x1", 1000, (0,), (50,), ("MAPT",), baseline=False).plans("oracle")
    config = {**asdict(plan), "pacing": "wait"}
    assert plan.differences(config) == []
    assert plan.differences(config | {"seed": 1, "pacing": "free"}) == ["seed is 1, not 0"]


def test_there_is_no_share_of_a_return_that_is_not_positive_or_not_known():
    assert math.isnan(rows_of([result(0, "true", -1.0), result(0, "preferences", 5.0)])[0].share)
    assert math.isnan(rows_of([result(0, "preferences", 5.0)])[0].share)


def test_results_are_written_as_json_csv_and_a_picture(tmp_path: Path):
    paths = write(tmp_path / "out", [result(0, "true", 100.0), result(0, "preferences", 80.0)])
    assert [path.name for path in paths] == ["results.json", "curves.csv", "returns.png"]
    assert json.loads(paths[0].read_text())["runs"][1]["final"] == 80.0
    assert paths[1].read_text().splitlines()[1] == "0,true,,,true_return,500,50.0"
    assert paths[2].stat().st_size > 10_000


def test_returns_by_labels_are_drawn_beside_the_curves(tmp_path: Path):
    runs = [
        result(0, "true", 100.0),
        *(result(seed, "preferences", 80.0 + seed, labels=n) for n in (50, 99) for seed in (0, 1)),
    ]
    one, two = write(tmp_path / "one", runs[:2])[2], write(tmp_path / "two", runs)[2]
    assert imread(two).shape[1] > imread(one).shape[1]


def test_many_kinds_of_runs_are_drawn_as_means(tmp_path: Path):
    kinds = [("true", 50), *(("preferences", labels) for labels in (20, 50, 99))]
    runs = [result(seed, source, 80.0 + seed, labels=labels) for source, labels in kinds for seed in (0, 1)]
    runs[-1] = replace(runs[-1], curves={})
    assert write(tmp_path, runs)[2].stat().st_size > 10_000


def test_a_run_without_an_ended_episode_can_be_drawn(tmp_path: Path):
    bare = replace(result(0, "preferences", 80.0), curves={})
    assert write(tmp_path, [bare])[2].exists()
