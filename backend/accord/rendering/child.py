"""The loop of a render process: `python -m accord.rendering.child <connection's descriptor> <parent's pid>`.

Started by `accord.rendering.process`, with the environment that `probe.render_environment` gives. Torch is
never imported here: EGL and CUDA in one process deadlock on some drivers.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import ctypes
import os
import signal
import sys
from collections import OrderedDict
from multiprocessing.connection import Connection

import mujoco

from accord.rendering.checks import DREW
from accord.rendering.process import ClipJob, Reply, receive_job, send_reply
from mapt.rendering.encode import write_clip
from mapt.rendering.renderer import ClipRenderer
from mapt.rendering.settings import RenderSettings
from mapt.tasks import agent_geoms, load_model

#: OpenGL contexts kept open, one for each task and look
RENDERERS_KEPT = 4
_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Serve jobs until the parent closes the connection or dies."""
    if sys.argv[1:] == ["probe"]:
        probe()
        return
    descriptor, parent = int(sys.argv[1]), int(sys.argv[2])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer: it ends this process itself
    die_with(parent)
    with Connection(descriptor) as connection:
        serve(connection)


def die_with(parent: int) -> None:
    """Be killed when the parent's thread that started this process ends, even in the middle of a hung driver."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it died before the line above
            raise SystemExit("the parent is gone")


def serve(connection: Connection) -> None:
    renderers = Renderers()
    send_reply(connection, Reply())
    while True:
        try:
            job = receive_job(connection)
        except (EOFError, ConnectionError):  # the parent is gone, or has no more work
            return
        send_reply(connection, answer(job, renderers))


def answer(job: ClipJob, renderers: "Renderers") -> Reply:
    try:
        renderer = renderers.get(job.task, job.settings)
        return Reply(clip=write_clip(renderer.frames(job.qpos, job.qvel), job.path, job.settings))
    except Exception as error:  # noqa: BLE001 - the edge of the loop: the parent hears what it was, and the next job may do
        return Reply(failure=f"{type(error).__name__}: {error}")


class Renderers:
    """One renderer for each task and look, the latest few."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[str, RenderSettings], ClipRenderer] = OrderedDict()

    def get(self, task: str, settings: RenderSettings) -> ClipRenderer:
        """The renderer for this look, opened if need be.

        Raises:
            mapt.tasks.UnknownTask: if no task has this name.
        """
        key = (task, settings)
        if key not in self._kept:
            self._kept[key] = ClipRenderer(load_model(task), agent_geoms(task), settings)
        self._kept.move_to_end(key)
        if len(self._kept) > RENDERERS_KEPT:
            _, oldest = self._kept.popitem(last=False)
            oldest.close()
        return self._kept[key]


BALL = """
<mujoco>
  <visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
  <worldbody><geom type="sphere" size="1" rgba="1 0 0 1"/></worldbody>
</mujoco>
"""


def probe() -> None:
    """Print that a frame was drawn, or what came instead of red."""
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 32, 32) as renderer:
        renderer.update_scene(data)
        red, green, blue = (int(channel) for channel in renderer.render()[16, 16])
    if red > 200 and green < 50 and blue < 50:
        print(DREW, flush=True)
    else:
        raise SystemExit(f"a red ball came out as ({red}, {green}, {blue})")


if __name__ == "__main__":
    main()
