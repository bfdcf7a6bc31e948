"""Videos of a policy: real EGL, real H.264."""

import os

import av
import numpy as np
import pytest

from accord.rendering.checks import probe_backend
from accord.rendering.process import RenderingUnavailable
from mapt.errors import NoRenderer
from mapt.policies import Policy, PolicyConfig
from mapt.policies.learner import make_policy
from mapt.rendering.episode_video import widen_floors
from mapt.tasks import PettingZooDefinition, load_model, register_task, task_spec
from mapt.training import video
from mapt.training.run import RunCallbacks, complete_run
from mapt.training.run_folder import RunFolder
from mapt.training.settings import RunSettings
from mapt.training.video import record_video
from support.levers import Levers, RenderableLevers
from support.short_tasks import SHORTEST_HORIZON_STEPS, SHORTEST_NAME

pytestmark = pytest.mark.usefixtures("short_episodes")

SMALL = {"hidden": [8], "device": "cpu", "n_envs": 2, "rollout_steps": 8, "minibatches": 1, "epochs": 1}


def policy_of(task_name: str) -> Policy:
    return make_policy(task_spec(task_name), PolicyConfig.from_dict(SMALL))


def frames(path) -> tuple[list[np.ndarray], float]:
    """Every frame (H,W,3), and how many are shown in a second."""
    with av.open(str(path)) as container:
        rate = container.streams.video[0].average_rate
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], float(rate or 0)


@pytest.fixture
def egl() -> str:
    """A backend that draws."""
    try:
        return probe_backend()
    except RenderingUnavailable as error:
        pytest.skip(str(error))


def test_a_video_shows_one_episode_in_real_time(egl, tmp_path):
    record_video(policy_of(SHORTEST_NAME), SHORTEST_NAME, tmp_path / "final.mp4", agent_obsk=1)
    shown, rate = frames(tmp_path / "final.mp4")
    assert len(shown) == SHORTEST_HORIZON_STEPS
    assert rate == pytest.approx(1 / task_spec(SHORTEST_NAME).step_seconds)
    assert np.ptp(shown[0]) > 100  # a body before its backdrop
    assert any(not np.array_equal(shown[0], other) for other in shown[1:])


def test_a_task_that_draws_itself_is_filmed_by_itself(tmp_path):
    class Large(RenderableLevers):
        def render(self) -> np.ndarray:
            return np.full((65, 97, 3), 40 * (1 + len(self.agents)), np.uint8)

    name = f"LargeLevers-{os.getpid()}"
    register_task(PettingZooDefinition(name, Large, 6, 0.5, "Pull."))
    record_video(policy_of(name), name, tmp_path / "final.mp4", agent_obsk=1)
    shown, rate = frames(tmp_path / "final.mp4")
    assert shown[0].shape == (64, 96, 3)
    assert 1 <= len(shown) <= 6
    assert rate == 2.0


def test_a_task_that_cannot_be_drawn_says_so(tmp_path):
    name = f"BlindLevers-{os.getpid()}"
    register_task(PettingZooDefinition(name, Levers, 6, 0.5, "Pull."))
    with pytest.raises(NoRenderer, match="rgb_array"):
        record_video(policy_of(name), name, tmp_path / "final.mp4", agent_obsk=1)


def test_a_machine_without_opengl_trains_and_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(video, "BACKENDS", ("glfw",))  # needs a display, and here is none
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    said: list[str] = []
    folder, settings = (
        RunFolder(tmp_path),
        RunSettings(task=SHORTEST_NAME, policy=PolicyConfig.from_dict(SMALL), steps=16),
    )
    assert complete_run(settings, folder, 0.0, RunCallbacks(on_message=said.append)) is not None
    assert len(said) == 1
    assert "libegl1" in said[0]
    assert not folder.video.exists()
    assert folder.evaluation.exists()


def test_a_video_that_was_missing_is_made_by_the_same_command(egl, tmp_path):
    folder, settings = (
        RunFolder(tmp_path),
        RunSettings(task=SHORTEST_NAME, policy=PolicyConfig.from_dict(SMALL), steps=16),
    )
    complete_run(settings, folder, 0.0, RunCallbacks(), video=False)
    evaluated = folder.evaluation.stat().st_mtime_ns
    complete_run(settings, folder, 0.0, RunCallbacks())
    assert folder.evaluation.stat().st_mtime_ns == evaluated
    filmed = folder.video.stat().st_mtime_ns
    complete_run(settings, folder, 0.0, RunCallbacks())
    assert folder.video.stat().st_mtime_ns == filmed


def test_a_floor_reaches_as_far_as_the_body():
    model = load_model("HalfCheetah-6x1")
    size = model.geom_size[0, :2].tolist()
    still = np.zeros((11, 9))
    widen_floors(model, still)
    assert model.geom_size[0, :2].tolist() == size
    still[-1, 0] = 300.0
    widen_floors(model, still)
    assert (model.geom_size[0, :2] > 320).all()
