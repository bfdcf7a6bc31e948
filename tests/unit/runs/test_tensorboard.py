"""Event files, as TensorBoard itself reads them."""

from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mapt.runs.metrics_file import Metrics
from mapt.runs.tensorboard import EventFile, tag


def line(iteration: int, **values: float | str) -> Metrics:
    return {"iteration": iteration, "steps": 100 * iteration, "time": 1.8e9 + iteration, **values}


def scalars(folder: Path) -> dict[str, list[tuple[int, float, float]]]:
    """(steps, value, time) of each curve."""
    read = EventAccumulator(str(folder)).Reload()
    return {
        name: [(event.step, event.value, event.wall_time) for event in read.Scalars(name)]
        for name in read.Tags()["scalars"]
    }


def test_numbers_become_curves_over_steps(tmp_path):
    events = EventFile(tmp_path, [])
    events.append(line(1, true_return=3.5, kl=0.25, reward_sha="abc"))
    events.append(line(2, kl=0.5))
    events.close()
    assert scalars(tmp_path) == {
        "return/true_return": [(100, 3.5, 1.8e9 + 1)],
        "learner/kl": [(100, 0.25, 1.8e9 + 1), (200, 0.5, 1.8e9 + 2)],
    }


def test_a_run_that_goes_on_has_every_point_once(tmp_path):
    before = EventFile(tmp_path, [])
    for iteration in (1, 2, 3):
        before.append(line(iteration, kl=float(iteration)))
    before.close()
    # The checkpoint was of iteration 2: the third is made again.
    after = EventFile(tmp_path, [line(1, kl=1.0), line(2, kl=2.0)])
    after.append(line(3, kl=4.0))
    after.close()
    assert [(step, value) for step, value, _ in scalars(tmp_path)["learner/kl"]] == [(100, 1.0), (200, 2.0), (300, 4.0)]


def test_curves_are_grouped():
    assert tag("evaluation_mean") == "evaluation/evaluation_mean"
    assert tag("seconds_physics") == "speed/seconds_physics"
    assert tag("entropy") == "learner/entropy"
