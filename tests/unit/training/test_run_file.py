"""Run files, the combinations of a sweep, and shares of them."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import InvalidConfig
from mapt.training.run_file import Cell, RunFile, Sweep, cells, merged, read_toml, share

NAMES = tuple(each.name for each in fields(RunFile))


def swept(settings: dict[str, object], *texts: str) -> list[Cell]:
    return cells(settings, [Sweep.parse(text) for text in texts], NAMES)


def test_a_file_in_toml_gives_settings(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text(
        'task = "Walker2d-2x3"\nsteps = 2000\nseeds = [3, 4]\n'
        '[policy]\nalgorithm = "happo"\nlearning_rate = 1e-3\n[reward]\npath = "rm"\ncredit = "individual"\n'
    )
    found = RunFile.from_dict(read_toml(path))
    assert (found.task, found.steps, found.seeds, found.device) == ("Walker2d-2x3", 2000, (3, 4), "auto")
    assert (found.reward.path, found.reward.credit, found.reward.segment_steps) == ("rm", "individual", None)
    config = found.policy_config(4)
    assert (config.algorithm, config.learning_rate, config.seed) == ("happo", 1e-3, 4)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("steps = 0", "steps is 0; it must be a whole number, 1 or more"),
        ("stepz = 1", "stepz is not a setting. The settings are: task, steps"),
        ("[policy]\nclipp = 0.1", "clipp is not a setting"),
        ("[policy]\nseed = 1", "policy.seed: use seeds"),
        ("[reward]\nkind = 'best'", "reward.kind is 'best'"),
        ("seeds = [1, 1]", "without repeats"),
        ("seeds = []", "seeds"),
        ("steps = ", "is not TOML"),
    ],
)
def test_an_invalid_file_is_refused(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "run.toml"
    path.write_text(text)
    with pytest.raises(InvalidConfig, match=problem.replace("[", r"\[")):
        RunFile.from_dict(read_toml(path))


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidConfig, match="cannot be read: No such file"):
        read_toml(tmp_path / "run.toml")


def test_every_combination_is_a_cell_named_by_its_values() -> None:
    settings: dict[str, object] = {"steps": 10, "policy": {"clip": 0.1, "gamma": 0.9}}
    found = swept(settings, "clip=0.2,0.3", "reward.credit=shared,individual", "steps=7")
    assert [cell.name for cell in found] == [
        "clip=0.2,reward.credit=shared,steps=7",
        "clip=0.2,reward.credit=individual,steps=7",
        "clip=0.3,reward.credit=shared,steps=7",
        "clip=0.3,reward.credit=individual,steps=7",
    ]
    assert found[1].settings == {"steps": 7, "policy": {"clip": 0.2, "gamma": 0.9}, "reward": {"credit": "individual"}}
    assert settings == {"steps": 10, "policy": {"clip": 0.1, "gamma": 0.9}}


def test_without_a_sweep_there_is_one_cell() -> None:
    assert swept({"steps": 1}) == [Cell("", {"steps": 1})]


def test_values_are_numbers_lists_and_texts() -> None:
    assert Sweep.parse("hidden=[64,64],[128]").values == ([64, 64], [128])
    assert Sweep.parse("algorithm=mat, mappo").values == ("mat", "mappo")
    assert Sweep.parse("learning_rate=1e-3,2e-3").values == (1e-3, 2e-3)
    assert [cell.name for cell in swept({}, "reward.path=runs/a b,../c")] == [
        "reward.path=runs_a_b",
        "reward.path=.._c",
    ]


@pytest.mark.parametrize("text", ["clip", "=1", "clip=", "clip=1,1", "clip=a,,b"])
def test_a_malformed_sweep_is_refused(text: str) -> None:
    with pytest.raises(InvalidConfig):
        Sweep.parse(text)


def test_sweeping_a_setting_twice_is_refused() -> None:
    with pytest.raises(InvalidConfig, match="twice"):
        swept({}, "clip=1", "policy.clip=2")


def test_values_that_would_share_a_folder_are_refused() -> None:
    with pytest.raises(InvalidConfig, match="same folder"):
        swept({}, "reward.path=a/b,a_b")


def test_changes_replace_single_nested_settings() -> None:
    assert merged({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"c": 4}}) == {"a": {"b": 1, "c": 4}, "d": 3}


@given(st.lists(st.integers(), max_size=30), st.integers(1, 12))
def test_shares_divide_the_items(items: Sequence[int], n: int) -> None:
    parts = [share(items, f"{k}/{n}") for k in range(1, n + 1)]
    assert sorted(item for part in parts for item in part) == sorted(items)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("which", ["0/3", "4/3", "1", "a/b", "1/0", "-1/3"])
def test_an_impossible_share_is_refused(which: str) -> None:
    with pytest.raises(InvalidConfig, match="K/N"):
        share([1, 2], which)
