"""Tables of the paper's experiments from results with known returns."""

from dataclasses import replace
from pathlib import Path

import pytest

from mapt.benchmarks.paper import UNTRAINED, PaperFolder, PaperPlan, PolicyJob, PolicyResult
from mapt.benchmarks.paper_tables import PaperResults, markdown, normalised_score, row_values
from mapt.policies import PolicyConfig
from mapt.training.run import RunJob
from mapt.training.settings import TRUE, RunSettings
from unit.benchmarks.tiny_dataset import write_dataset

FIRST, SECOND = "HalfCheetah-6x1", "Walker2d-2x3"
PLAN = PaperPlan(
    tasks=(FIRST, SECOND),
    pairs=(2000, 500),
    models=("MAPT", "MAPT-TPA", "MA-MLP"),
    policies=("mappo",),
    seeds=(0, 1),
    steps=1000,
    preset="small",
    test_pairs=10,
    device="cpu",
    segment_steps=50,
    segments=100,
    dataset_steps=4096,
)


def result(
    task: str, reward: str, pairs: int | None, seed: int, mean: float, success: float | None = None
) -> PolicyResult:
    settings = RunSettings(task=task, policy=PolicyConfig(seed=seed), steps=1000)
    return PolicyResult(
        PolicyJob("mappo", reward, pairs, RunJob(settings, Path("run"), 0.0, False, 1)), mean, mean, None, success
    )


BASELINES = [
    result(task, reward, None, seed, value)
    for task, scale in ((FIRST, 1.0), (SECOND, 10.0))
    for reward, value in ((UNTRAINED, -100.0 * scale), (TRUE, 900.0 * scale))
    for seed in (0, 1)
]
MAPT = [
    result(FIRST, "MAPT", 500, 0, 400.0),
    result(FIRST, "MAPT", 500, 1, 650.0),
    result(SECOND, "MAPT", 500, 0, 9000.0),
    result(SECOND, "MAPT", 500, 1, -1000.0),
]


def results(*policies: PolicyResult) -> PaperResults:
    return PaperResults(PLAN, tuple(policies), ())


def row_of(found: PaperResults, task: str | None, reward: str, pairs: int | None) -> dict[str, object]:
    rows = [*found.rows, *found.rows_over_tasks]
    return next(row_values(row) for row in rows if (row.task, row.reward, row.pairs) == (task, reward, pairs))


def test_scores_are_relative_to_the_untrained_and_the_true_return_of_the_seed():
    assert normalised_score(400.0, -100.0, 900.0) == 0.5
    assert normalised_score(1900.0, -100.0, 900.0) == 2.0
    assert normalised_score(400.0, 900.0, 900.0) is None
    row = row_of(results(*BASELINES, *MAPT), FIRST, "MAPT", 500)
    assert (row["seeds"], row["mean"], row["score_seeds"]) == (2, 525.0, 2)
    assert row["score_mean"] == row["score_iqm"] == pytest.approx(0.625)
    # Two seeds resample to their values or their mean.
    assert (row["score_low"], row["score_high"]) == (pytest.approx(0.5), pytest.approx(0.75))


def test_rows_over_tasks_pool_the_scores():
    row = row_of(results(*BASELINES, *MAPT), None, "MAPT", 500)
    assert (row["seeds"], row["mean"], row["score_seeds"]) == (0, None, 4)
    # Of 0, 0.5, 0.75 and 1, the middle two.
    assert row["score_iqm"] == pytest.approx(0.625)
    assert row["score_mean"] == pytest.approx(0.5625)


def test_a_seed_without_a_baseline_has_a_return_but_no_score():
    only_first = [one for one in BASELINES if one.job.seed == 0]
    row = row_of(results(*only_first, *MAPT), FIRST, "MAPT", 500)
    assert (row["seeds"], row["score_seeds"]) == (2, 1)
    assert row["score_iqm"] == pytest.approx(0.5)
    assert row["score_low"] is None


def test_the_page_has_tables_1_and_2_and_the_papers_figures():
    page = markdown(results(*BASELINES, *MAPT))
    assert "| HalfCheetah-6x1 | 500 | -100 ± 0 | 900 ± 0 | 525 ± 177 |  |  |" in page
    assert "| HalfCheetah-6x1, the paper's MAT | 30,000 |  | 4,484 ± 75 | 2,424 ± 128 |  | -88.75 ± 11.62 |" in page
    assert "| HalfCheetah-6x1 | 500 | 62% [50, 75] |  |  |" in page
    assert "| all tasks | 500 | 62% [" in page
    assert "## Table 2" in page
    # MAPT* is not in the plan.
    assert "## Table 3" not in page


def test_a_model_with_a_setting_of_ones_own_has_no_figure_of_the_paper():
    own = "MAPT:train.novelty_weight=1"
    plan = replace(PLAN, tasks=(FIRST,), pairs=(500,), models=("MAPT", own))
    page = markdown(PaperResults(plan, (*BASELINES, *MAPT), ()))
    assert f"| return | pairs | untrained | true reward | MAPT | {own} |" in page
    assert "| HalfCheetah-6x1, the paper's MAT | 30,000 |  | 4,484 ± 75 | 2,424 ± 128 |  |" in page


def test_successes_have_a_table_and_small_returns_decimals():
    plan = replace(PLAN, tasks=("3m", FIRST), pairs=(500,), models=("MAPT",))
    policies = [
        result("3m", UNTRAINED, None, 0, 1.25, 0.0),
        result("3m", UNTRAINED, None, 1, 0.75, 0.0),
        result("3m", "MAPT", 500, 0, 17.5, 0.75),
        result(FIRST, "MAPT", 500, 0, 400.0),
    ]
    found = PaperResults(plan, tuple(policies), ())
    page = markdown(found)
    assert "| 3m | 500 | 1.00 ± 0.35 |  | 17.50 (1) |" in page
    assert "| 3m, the paper's MAT | 50,000 |  | 20.00 ± 0.00 | 19.98 ± 0.05 |" in page
    success = page.partition("| success |")[2].partition("\n\n")[0]
    assert "| 3m | 500 | 0% |  | 75% (1) |" in success
    assert FIRST not in success
    assert row_of(found, "3m", "MAPT", 500)["success_mean"] == 0.75
    assert "success |" not in markdown(results(*BASELINES))


def test_an_incomplete_row_says_how_many_seeds_it_has():
    page = markdown(results(*BASELINES, MAPT[0]))
    assert "| HalfCheetah-6x1 | 500 | -100 ± 0 | 900 ± 0 | 400 (1) |  |  |" in page
    assert "| HalfCheetah-6x1 | 500 | 50% |  |  |" in page


def test_missing_results_are_listed_in_the_order_in_which_they_are_computed():
    missing = results(*BASELINES, *MAPT).missing
    assert len(missing) == 2 * 2 * 2 * 3 - len(MAPT)
    assert missing[0] == "HalfCheetah-6x1, mappo, MAPT-TPA on 500 pairs, seed 0"
    assert missing[-1] == "Walker2d-2x3, mappo, MA-MLP on 2,000 pairs, seed 1"


def test_imitation_has_columns_and_no_results_for_a_policy_without_single_actors():
    plan = replace(PLAN, tasks=(FIRST,), policies=("mappo", "mat"), imitation=("OMAR", "MAGAIL", "O-MAPL"))
    found = PaperResults(
        plan, (*BASELINES[:4], result(FIRST, "OMAR", None, 0, 500.0), result(FIRST, "O-MAPL", 500, 0, 100.0)), ()
    )
    page = markdown(found)
    mappo, mat = page.split("## Table 1: mat\n")
    # The paper's figure of OMAR is below ours.
    assert "4,089 ± 166" in mappo
    assert next(line for line in mappo.splitlines() if "| 500 |" in line).count("500 (1)") == 1
    assert "mappo, OMAR, seed 1" in page
    assert "mat, MAGAIL, seed 0" in page
    assert "mat, OMAR, seed" not in page
    assert "mat, O-MAPL on 500 pairs" not in page
    assert row_of(found, FIRST, "O-MAPL", 500)["mean"] == 100.0
    assert mat


def test_rewards_keep_their_mean_where_episodes_can_end(tmp_path):
    plan = replace(PLAN, tasks=(FIRST, "3m"), seeds=(0,), pairs=(30,), models=("MAPT",))
    for task in plan.tasks:
        write_dataset(tmp_path / "datasets" / task / "seed-0", task=task)
    jobs = PaperFolder(tmp_path, plan).model_jobs()
    assert {job.settings.task: job.settings.training["subtract_mean"] for job in jobs} == {FIRST: True, "3m": False}
