"""A cell is found again by exactly its settings, and by no others."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mapt.studies.cell import CellSettings, run_cell
from mapt.studies.cell_folder import CellFolder
from mapt.studies.errors import DamagedCell
from mapt.studies.pairs import split_replay
from mapt.studies.plan import TablePlan, table_jobs
from unit.studies.tiny_replay import TASK

PLAN = TablePlan(
    task=TASK,
    models=("MA-MLP:hidden_dim=8:train.markov_epochs=2",),
    teachers=("oracle",),
    labels=(30,),
    seeds=(0,),
    preset="small",
    test_pairs=200,
    device="cpu",
    baseline="MA-MLP:hidden_dim=8:train.markov_epochs=2",
)


@pytest.fixture
def settings(replay) -> CellSettings:
    return table_jobs(PLAN, {0: replay})[0].settings


def test_a_cell_has_every_metric_of_the_table(replay, settings):
    metrics = run_cell(settings, replay).metrics
    expected = {"accuracy", "label_accuracy", "loss", "ece", "rank_correlation", "rank_correlation_teacher"}
    expected |= {"step_correlation", "step_correlation_within", "parameters", "seconds", "cpu_seconds"}
    assert expected <= metrics.keys()
    assert all(np.isfinite(value) for value in metrics.values())


def test_the_same_settings_give_the_same_cell(replay, settings):
    first, second = (run_cell(settings, replay) for _ in range(2))
    np.testing.assert_array_equal(first.logits, second.logits)


def test_a_cell_is_tested_on_segments_it_has_not_learned_from(replay, settings):
    assert set(run_cell(settings, replay).pairs.ravel()) <= set(split_replay(len(replay), settings.seed).test)


def test_a_stopped_cell_is_none(replay, settings):
    assert run_cell(settings, replay, stop=lambda: True) is None


def test_a_cell_reads_back_as_it_was_written(tmp_path, replay, settings):
    folder, examined = CellFolder(tmp_path / "cells"), run_cell(settings, replay)
    assert folder.read(settings) is None
    folder.write(settings, examined, "abc")
    cell = folder.read(settings)
    assert cell.code == "abc"
    assert cell.result.metrics == examined.metrics
    for name in ("logits", "labels", "clean_labels", "pairs"):
        np.testing.assert_array_equal(getattr(cell.result, name), getattr(examined, name))


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 1},
        {"labels": 31},
        {"teacher": "mistake"},
        {"model": "MAPT"},
        {"test_pairs": 201},
        {"replay": "0" * 64},
        {"task": "Other"},
        {"network": {"hidden_dim": 16}},
        {"training": {"lr": 1.0}},
        {"teacher_parameters": {"mistake": 0.2}},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_a_cell_of_other_settings_is_another(tmp_path, replay, settings, changes):
    folder = CellFolder(tmp_path / "cells")
    folder.write(settings, run_cell(settings, replay), "abc")
    assert folder.read(replace(settings, **changes)) is None


def test_a_file_whose_settings_are_not_those_of_its_name_is_refused(tmp_path, replay, settings):
    folder = CellFolder(tmp_path / "cells")
    folder.write(settings, run_cell(settings, replay), "abc")
    path = folder.path / f"{settings.key}.json"
    card = json.loads(path.read_text())
    card["settings"]["training"]["lr"] = 0.5
    path.write_text(json.dumps(card))
    with pytest.raises(DamagedCell, match="settings"):
        folder.read(settings)


@pytest.mark.parametrize("suffix", ["json", "safetensors"])
def test_a_file_cut_short_is_refused(tmp_path, replay, settings, suffix):
    folder = CellFolder(tmp_path / "cells")
    folder.write(settings, run_cell(settings, replay), "abc")
    path = folder.path / f"{settings.key}.{suffix}"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(DamagedCell, match="delete it"):
        folder.read(settings)


def test_arrays_without_a_card_are_no_cell(tmp_path, replay, settings):
    folder = CellFolder(tmp_path / "cells")
    folder.write(settings, run_cell(settings, replay), "abc")
    (folder.path / f"{settings.key}.json").unlink()
    assert folder.read(settings) is None
