"""Validation of render settings, and messages to and from the render process."""

from multiprocessing import Pipe
from pathlib import Path

import numpy as np
import pytest

from accord.rendering.process import ClipJob, Reply, receive_job, receive_reply, send_job, send_reply
from mapt.rendering.encode import ClipFile
from mapt.rendering.settings import CodecSettings, RenderSettings


@pytest.mark.parametrize("size", [(321, 240), (320, 0), (-2, 240)])
def test_size_that_cannot_be_encoded_is_rejected(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="positive and even"):
        RenderSettings(width=size[0], height=size[1])


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan")])
def test_invalid_frame_rate_is_rejected(rate: float) -> None:
    with pytest.raises(ValueError, match="frame rate"):
        RenderSettings(frame_rate_hz=rate)


def test_job_survives_the_connection() -> None:
    settings = RenderSettings(320, 240, 12.5, "pretty", codec=CodecSettings("fast", 20, 7))
    states = np.random.default_rng(0).standard_normal((2, 3, 9))
    job = ClipJob("HalfCheetah-6x1", states[0], states[1], settings, Path("/clips/a.mp4"))
    parent, child = Pipe()
    with parent, child:
        send_job(parent, job)
        arrived = receive_job(child)
    np.testing.assert_array_equal(arrived.qpos, job.qpos)
    np.testing.assert_array_equal(arrived.qvel, job.qvel)
    assert (arrived.task, arrived.settings, arrived.path) == (job.task, job.settings, job.path)


@pytest.mark.parametrize(
    "reply",
    [Reply(), Reply(failure="no"), Reply(clip=ClipFile(Path("/clips/a.mp4"), 50, 2.5, 320, 240, 1234))],
)
def test_reply_survives_the_connection(reply: Reply) -> None:
    parent, child = Pipe()
    with parent, child:
        send_reply(child, reply)
        assert receive_reply(parent) == reply
