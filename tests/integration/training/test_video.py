"""Videos of a policy, rendered by OpenGL and encoded as H.264."""

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
    """The frames (H,W,3) of a video and their number per second."""
    with av.open(str(path)) as container:
        rate = container.streams.video[0].average_rate
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], float(rate or 0)


@pytest.fixture
def egl() -> str:
    """A backend that renders without a display. Skips the test if there is none."""
    try:
        return probe_backend()
    except RenderingUnavailable as error:
        pytest.skip(str(error))


def test_a_video_shows_one_episode_in_real_time(egl, tmp_path):
    record_video(policy_of(SHORTEST_NAME), SHORTEST_NAME, tmp_path / "final.mp4", agent_obsk=1)
    shown, rate = frames(tmp_path / "final.mp4")
    assert len(shown) == SHORTEST_HORIZON_STEPS
    assert rate == pytest.approx(1 / task_spec(SHORTEST_NAME).step_seconds)
    assert np.ptp(shown[0]) > 100  # the body differs from the background
    assert any(not np.array_equal(shown[0], other) for other in shown[1:])


def test_the_video_of_a_pettingzoo_task_has_the_environments_images(tmp_path):
    class LargeLevers(RenderableLevers):
        def render(self) -> np.ndarray:
            return np.full((65, 97, 3), 40 * (1 + len(self.agents)), np.uint8)

    name = f"LargeLevers-{os.getpid()}"
    register_task(PettingZooDefinition(name, LargeLevers, 6, 0.5, "Pull."))
    record_video(policy_of(name), name, tmp_path / "final.mp4", agent_obsk=1)
    shown, rate = frames(tmp_path / "final.mp4")
    assert shown[0].shape == (64, 96, 3)
    assert 1 <= len(shown) <= 6
    assert rate == 2.0


def test_the_video_of_a_skirmish_is_drawn_without_opengl(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "run_rendering_module", None)
    record_video(policy_of("3m"), "3m", tmp_path / "final.mp4", agent_obsk=1)
    shown, rate = frames(tmp_path / "final.mp4")
    assert shown[0].shape == (480, 640, 3)
    assert 5 <= len(shown) <= task_spec("3m").horizon_steps
    assert rate == 8.0


def test_a_task_that_cannot_be_rendered_has_no_video(tmp_path):
    name = f"BlindLevers-{os.getpid()}"
    register_task(PettingZooDefinition(name, Levers, 6, 0.5, "Pull."))
    with pytest.raises(NoRenderer, match="rgb_array"):
        record_video(policy_of(name), name, tmp_path / "final.mp4", agent_obsk=1)


def test_a_run_without_opengl_finishes_and_names_the_package_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(video, "BACKENDS", ("glfw",))  # needs a display
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    messages: list[str] = []
    folder, settings = (
        RunFolder(tmp_path),
        RunSettings(task=SHORTEST_NAME, policy=PolicyConfig.from_dict(SMALL), steps=16),
    )
    assert complete_run(settings, folder, 0.0, RunCallbacks(on_message=messages.append)) is not None
    assert len(messages) == 1
    assert "libegl1" in messages[0]
    assert not folder.video.exists()
    assert folder.evaluation.exists()


def test_a_missing_video_is_recorded_when_the_run_is_completed_again(egl, tmp_path):
    folder, settings = (
        RunFolder(tmp_path),
        RunSettings(task=SHORTEST_NAME, policy=PolicyConfig.from_dict(SMALL), steps=16),
    )
    complete_run(settings, folder, 0.0, RunCallbacks(), video=False)
    evaluated_at = folder.evaluation.stat().st_mtime_ns
    complete_run(settings, folder, 0.0, RunCallbacks())
    assert folder.evaluation.stat().st_mtime_ns == evaluated_at
    recorded_at = folder.video.stat().st_mtime_ns
    complete_run(settings, folder, 0.0, RunCallbacks())
    assert folder.video.stat().st_mtime_ns == recorded_at


def test_floors_are_widened_to_the_bodys_farthest_position():
    model = load_model("HalfCheetah-6x1")
    size = model.geom_size[0, :2].tolist()
    qpos = np.zeros((11, 9))
    widen_floors(model, qpos)
    assert model.geom_size[0, :2].tolist() == size
    qpos[-1, 0] = 300.0
    widen_floors(model, qpos)
    assert (model.geom_size[0, :2] > 320).all()
