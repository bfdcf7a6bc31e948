"""The metrics file and the TensorBoard events of a run: no iteration is missing or repeated."""

from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mapt.errors import DamagedRun
from mapt.training.metrics import EventFile, Metrics, MetricsFile, read_metrics, tag


def test_lines_are_read_back_while_they_are_written(tmp_path):
    file = MetricsFile(tmp_path / "metrics.jsonl", 0)
    file.append({"iteration": 1, "reward_sha": "abc"})
    assert read_metrics(tmp_path / "metrics.jsonl") == [{"iteration": 1, "reward_sha": "abc"}]
    file.close()


def test_lines_after_the_checkpoint_are_discarded(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"iteration": 1}\n{"iteration": 2}\n{"iteration": 3}\n{"iter')
    file = MetricsFile(path, 2)
    assert [line["iteration"] for line in read_metrics(path)] == [1, 2]
    file.append({"iteration": 3.5})
    file.close()
    assert [line["iteration"] for line in read_metrics(path)] == [1, 2, 3.5]


@pytest.mark.parametrize("content", ["", '{"iteration": 1}\n', '{"iteration": 1}\n{"iteration": 2}'])
def test_fewer_lines_than_the_checkpoint_counts_are_refused(tmp_path, content):
    path = tmp_path / "metrics.jsonl"
    path.write_text(content)
    with pytest.raises(DamagedRun):
        MetricsFile(path, 2)
    assert path.read_text() == content


def test_an_incomplete_last_line_is_ignored(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"iteration": 1}\n{"itera')
    assert read_metrics(path) == [{"iteration": 1}]


@pytest.mark.parametrize("content", ["no json\n", "[1]\n"])
def test_a_line_that_is_not_a_json_object_is_refused(tmp_path, content):
    (tmp_path / "metrics.jsonl").write_text(content)
    with pytest.raises(DamagedRun):
        read_metrics(tmp_path / "metrics.jsonl")


def line(iteration: int, **values: float | str) -> Metrics:
    return {"iteration": iteration, "steps": 100 * iteration, "time": 1.8e9 + iteration, **values}


def scalars(folder: Path) -> dict[str, list[tuple[int, float, float]]]:
    """(steps, value, time) of every point, by curve."""
    read = EventAccumulator(str(folder)).Reload()
    return {
        name: [(event.step, event.value, event.wall_time) for event in read.Scalars(name)]
        for name in read.Tags()["scalars"]
    }


def test_numeric_metrics_become_scalar_events(tmp_path):
    events = EventFile(tmp_path, [])
    events.append(line(1, true_return=3.5, kl=0.25, reward_sha="abc"))
    events.append(line(2, kl=0.5))
    events.close()
    assert scalars(tmp_path) == {
        "return/true_return": [(100, 3.5, 1.8e9 + 1)],
        "learner/kl": [(100, 0.25, 1.8e9 + 1), (200, 0.5, 1.8e9 + 2)],
    }


def test_a_resumed_run_has_every_event_once(tmp_path):
    before = EventFile(tmp_path, [])
    for iteration in (1, 2, 3):
        before.append(line(iteration, kl=float(iteration)))
    before.close()
    # The checkpoint is of iteration 2, so iteration 3 is repeated.
    after = EventFile(tmp_path, [line(1, kl=1.0), line(2, kl=2.0)])
    after.append(line(3, kl=4.0))
    after.close()
    assert [(step, value) for step, value, _ in scalars(tmp_path)["learner/kl"]] == [(100, 1.0), (200, 2.0), (300, 4.0)]


def test_tags_group_the_curves():
    assert tag("evaluation_mean") == "evaluation/evaluation_mean"
    assert tag("seconds_physics") == "speed/seconds_physics"
    assert tag("entropy") == "learner/entropy"
