"""Renders frames in a child process, as in production; pytest's process imports mujoco without OpenGL.

The child runs `drawing.py FOLDER TASK AGENT_GEOMS SETTINGS`, the last two as JSON. FOLDER contains qpos.npy.
"""

import json
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapt.rendering.offscreen import Backend, render_environment
from mapt.rendering.renderer import ClipRenderer
from mapt.rendering.settings import CodecSettings, RenderSettings
from mapt.tasks import load_model

CHEETAH = "HalfCheetah-6x1"


@dataclass(frozen=True, slots=True)
class Drawing:
    """Renders in child processes, which exchange files in a folder."""

    backend: Backend
    folder: Path

    def frames(
        self, qpos: NDArray[np.float64], agents: list[list[int]], settings: RenderSettings, task: str = CHEETAH
    ) -> NDArray[np.uint8]:
        """Frames (T,H,W,3) of states (T,nq), rendered by a new process."""
        np.save(self.folder / "qpos.npy", qpos)
        arguments = [str(self.folder), task, json.dumps(agents), json.dumps(asdict(settings))]
        subprocess.run([sys.executable, __file__, *arguments], env=render_environment(self.backend), check=True)
        return np.load(self.folder / "frames.npy")


def main() -> None:
    folder, task, agents, given = Path(sys.argv[1]), sys.argv[2], json.loads(sys.argv[3]), json.loads(sys.argv[4])
    settings = RenderSettings(**given | {"codec": CodecSettings(**given["codec"])})
    qpos, model = np.load(folder / "qpos.npy"), load_model(task)
    with ClipRenderer(model, agents, settings) as renderer:
        np.save(folder / "frames.npy", np.stack(list(renderer.frames(qpos, np.zeros((len(qpos), model.nv))))))


if __name__ == "__main__":
    main()
