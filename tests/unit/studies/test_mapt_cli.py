"""The mapt command: what it refuses in one sentence, what it leaves behind, and that a killed run goes on."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from mapt.studies.errors import InvalidStudy
from mapt.studies.naming import numbers, words
from support.waiting import until
from unit.studies.tiny_replay import TASK, write_replay

MODELS = "MA-MLP:hidden_dim=8:train.markov_epochs=1,MAPT:hidden_dim=8:train.markov_epochs=1:train.max_epochs=1"


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "mapt.cli", *map(str, arguments)]


@pytest.fixture(scope="module")
def replays(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("replays")
    for seed in (0, 1):
        write_replay(root / f"seed-{seed}", seed)
    return root


def table_arguments(replays: Path, output: Path) -> list[str | Path]:
    plan = ["--task", TASK, "--models", MODELS, "--labels", "30", "--seeds", "0,1", "--test-pairs", "100"]
    return ["table", *plan, "--replay", replays, "--output", output]


def arrays(output: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((output / "cells").glob("*.safetensors"))}


def test_a_killed_table_goes_on_and_is_the_same_as_one_that_was_not(tmp_path, replays, mapt):
    process = subprocess.Popen(
        command(*table_arguments(replays, tmp_path / "killed"), "--workers", "1"), stdout=subprocess.DEVNULL
    )
    cells = tmp_path / "killed" / "cells"
    until(lambda: process.poll() is not None or list(cells.glob("*.json")), "a finished cell")
    assert process.poll() is None
    process.kill()
    process.wait()
    made = {path: path.stat().st_mtime_ns for path in cells.glob("*.json")}
    resumed = mapt(*table_arguments(replays, tmp_path / "killed"))
    assert resumed.status == 0, resumed.errors
    assert {path: path.stat().st_mtime_ns for path in made} == made
    whole = mapt(*table_arguments(replays, tmp_path / "whole"), "--workers", "2", "--keep-models")
    assert whole.status == 0, whole.errors
    assert len(arrays(tmp_path / "whole")) == 4
    assert arrays(tmp_path / "killed") == arrays(tmp_path / "whole")
    assert "not finished" not in (tmp_path / "whole" / "table.md").read_text()
    assert len(list((tmp_path / "whole" / "models").glob("*/reward.json"))) == 4


def test_a_dry_run_makes_no_cell_and_leaves_a_table_with_empty_places(tmp_path, replays, mapt):
    assert mapt(*table_arguments(replays, tmp_path), "--dry-run").status == 0
    assert not (tmp_path / "cells").exists()
    assert "4 cells are not finished" in (tmp_path / "table.md").read_text()
    assert len((tmp_path / "cells.csv").read_text().splitlines()) == 1
    assert (tmp_path / "table.png").read_bytes().startswith(b"\x89PNG")


def test_a_table_that_lacks_cells_ends_with_status_1(tmp_path, replays, mapt):
    # A teacher who skips every pair never gives 30 labels.
    failed = mapt(*table_arguments(replays, tmp_path), "--teachers", "skip:skip=1000")
    assert failed.status == 1
    assert "gave 0 of 30 labels" in failed.errors
    assert "4 cells are missing" in failed.errors


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--models", "Nobody"], "no reward model is called 'Nobody'"),
        (["--teachers", "nobody"], "no teacher is called 'nobody'"),
        (["--labels", "many"], "it looks like 0,1,2"),
        (["--baseline", "MAPT*"], "none of the models"),
        (["--task", "HalfCheetah-6x1"], "is of Tiny"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(tmp_path, replays, mapt, arguments, sentence):
    refused = mapt(*table_arguments(replays, tmp_path), *arguments)
    assert refused.status == 2
    assert refused.errors.startswith("mapt: ")
    assert sentence in refused.errors


def test_dataset_records_the_replay_of_a_seed(tmp_path, mapt):
    counts = ["--policy-steps", "4096", "--segment-steps", "20", "--segments", "10"]
    made = mapt("dataset", "--task", "HalfCheetah-2x3", "--seeds", "2", *counts, "--output", tmp_path)
    assert made.status == 0, made.errors
    about = json.loads((tmp_path / "seed-2" / "manifest.json").read_text())
    assert (about["n_segments"], about["about"]["seed"]) == (10, 2)


def test_lists_are_read_with_commas():
    assert words("--models", "MAPT, MA-MLP") == ("MAPT", "MA-MLP")
    assert numbers("--seeds", "0,2", 0) == (0, 2)


@pytest.mark.parametrize("text", ["", "0,,1", "0,0", "1,-1", "a"])
def test_lists_that_make_no_sense_are_refused(text):
    with pytest.raises(InvalidStudy, match="--seeds"):
        numbers("--seeds", text, 0)
