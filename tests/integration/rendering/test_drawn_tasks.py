"""Clips of tasks that have a drawing, by the renderer and by the render process."""

from contextlib import closing
from pathlib import Path

import av
import numpy as np
import pytest

from accord.rendering.process import ClipJob, RenderFailed, RenderProcess
from mapt.rendering.appearance import AGENT_COLOURS, rgb_bytes
from mapt.rendering.camera import cameras_of
from mapt.rendering.drawn_renderer import DrawnRenderer
from mapt.rendering.offscreen import Backend
from mapt.rendering.settings import RenderSettings
from mapt.tasks import find_drawing, make_task, task_spec

SETTINGS = RenderSettings(width=320, height=240, frame_rate_hz=8.0)


@pytest.fixture(scope="module")
def states() -> np.ndarray:
    """Five states (T, nq) of 3m, in which nobody moves."""
    task = make_task("3m", 1)
    task.reset(0)
    seen = []
    for _ in range(5):
        seen.append(task.simulator_state()[0][0])
        task.step(np.eye(9)[[[1, 1, 1]]])
    return np.array(seen)


def renderer() -> DrawnRenderer:
    drawing = find_drawing("3m")
    assert drawing is not None
    return DrawnRenderer(drawing, task_spec("3m"), SETTINGS)


def test_frames_show_the_agents_in_the_colours_of_the_legend(states: np.ndarray) -> None:
    frames = list(renderer().frames(states, np.zeros((5, 0))))
    assert [frame.shape for frame in frames] == [(240, 320, 3)] * 5
    for colour in AGENT_COLOURS[:3]:
        assert (np.abs(frames[0].astype(int) - rgb_bytes(colour)).max(axis=-1) < 10).sum() > 5


@pytest.mark.parametrize("wrong", [np.zeros((0, 30)), np.zeros((2, 29)), np.full((1, 30), np.nan)])
def test_states_that_cannot_be_drawn_are_refused(wrong: np.ndarray) -> None:
    with pytest.raises(ValueError, match="tates"):
        list(renderer().frames(wrong, np.zeros((len(wrong), 0))))


def test_a_drawn_task_has_one_camera() -> None:
    assert cameras_of("3m") == ("follow",)
    assert find_drawing("HalfCheetah-6x1") is None


def test_the_render_process_draws_clips_and_reports_wrong_states(
    backend: Backend, states: np.ndarray, tmp_path: Path
) -> None:
    with closing(RenderProcess(backend)) as process:
        clip = process.render(ClipJob("3m", states, np.zeros((5, 0)), SETTINGS, tmp_path / "clip.mp4"))
        assert (clip.frames, clip.seconds, clip.width, clip.height) == (5, 5 / 8, 320, 240)
        with av.open(str(clip.path)) as container:
            shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        drawn = list(renderer().frames(states, np.zeros((5, 0))))
        assert np.abs(np.stack(shown).astype(int) - np.stack(drawn)).mean() < 6  # as far as encoding keeps them
        with pytest.raises(RenderFailed, match="States must have shape"):
            process.render(ClipJob("3m", states[:, 1:], np.zeros((5, 0)), SETTINGS, tmp_path / "wrong.mp4"))
