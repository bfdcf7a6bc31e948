"""`mapt imitate` and `mapt dataset --policy` on tiny tasks."""

import json

import pytest

from mapt.benchmarks.recorded_dataset import RecordedDataset
from mapt.training.run_folder import RunFolder
from support.demonstrations import write_segments
from support.short_tasks import SHORTEST_NAME

pytestmark = pytest.mark.usefixtures("short_episodes")
POLICY = (
    *("--set", "policy.hidden=[8]", "--set", "policy.n_envs=4", "--set", "policy.rollout_steps=8"),
    *("--set", "policy.minibatches=1", "--device", "cpu", "--no-video", "--workers", "1"),
)


def test_a_recorded_policy_is_imitated_and_compared(mapt, tmp_path):
    tiny = [
        part
        for setting in ("n_envs=4", "rollout_steps=24", "minibatches=2", "hidden=[8]")
        for part in ("--set", setting)
    ]
    trained = mapt(
        *("train", "--task", SHORTEST_NAME, "--steps", "96", "--output", tmp_path / "expert"),
        *(*tiny, "--device", "cpu", "--no-video", "--workers", "1"),
    )
    assert trained.status == 0, trained.errors
    recorded = mapt(
        *("dataset", "--policy", tmp_path / "expert" / "seed-0", "--segments", "12", "--segment-steps", "10"),
        *("--output", tmp_path / "data", "--workers", "1"),
    )
    assert recorded.status == 0, recorded.errors
    dataset = RecordedDataset.open(tmp_path / "data" / "seed-0")
    assert len(dataset) == 12
    assert dataset.origin["task"] == SHORTEST_NAME
    assert dataset.origin["policy_steps"] == 96

    for algorithm, steps in (("bc", 20), ("omar", 20), ("magail", 32), ("o-mapl", 20)):
        done = mapt(
            *("imitate", "--algorithm", algorithm, "--data", tmp_path / "data" / "seed-0", "--steps", str(steps)),
            *("--output", tmp_path / algorithm, "--set", "batch=8", *POLICY),
            *(("--pairs", "8") if algorithm == "o-mapl" else ()),
        )
        assert done.status == 0, done.errors
        assert f"policy's return {dataset.origin['policy_return']:,.0f}" in done.printed
        assert RunFolder(tmp_path / algorithm / "seed-0").read_evaluation(steps) is not None
    cloned, improved = tmp_path / "bc" / "seed-0", tmp_path / "improved"
    # Its networks are those of the cloned policy.
    settings = [each.removeprefix("policy.") for each in POLICY[2:]]
    improving = ("train", "--task", SHORTEST_NAME, "--steps", "32", "--initial-policy", cloned, "--output", improved)
    done = mapt(*improving, *settings)
    assert done.status == 0, done.errors
    assert RunFolder(improved / "seed-0").settings().initial_policy is not None
    evaluated = mapt("evaluate", tmp_path / "omar" / "seed-0", "--episodes", "2", "--json")
    assert json.loads(evaluated.printed)["algorithm"] == "omar"
    compared = mapt("curves", tmp_path, "--output", tmp_path / "curves.png", "--table", tmp_path / "curves.md")
    assert compared.status == 0, compared.errors
    table = (tmp_path / "curves.md").read_text()
    assert "| omar | data/seed-0 | 20 |" in table
    assert "| o-mapl | data/seed-0, 8 labels | 20 |" in table


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--algorithm", "nothing"), "algorithm"),
        (("--set", "search_elites=11"), "search_elites"),
        (("--set", "policy.clip=-1"), "clip"),
        (("--set", "policy.seed=1"), "--seeds"),
        (("--set", "policy.algorithm=mat"), "mappo, happo or mat_dec"),
        (("--data", "."), "mapt dataset"),
        (("--pairs", "8"), "labelled pairs"),
        (("--algorithm", "o-mapl"), "labelled pairs"),
        (("--algorithm", "o-mapl", "--pairs", "8", "--teacher", "nobody"), "nobody"),
    ],
)
def test_invalid_arguments_are_refused_before_any_work(mapt, tmp_path, arguments, message):
    data = write_segments(tmp_path / "data")
    done = mapt("imitate", "--data", data, "--output", tmp_path / "run", *POLICY, *arguments)
    assert done.status == 2
    assert message in done.errors
    assert not (tmp_path / "run").exists()
