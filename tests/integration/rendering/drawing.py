"""Renders frames in a child process, as in production; pytest's process imports mujoco without OpenGL.

The child runs `drawing.py FOLDER`. It reads requests as lines of JSON and the states from FOLDER/qpos.npy, writes
FOLDER/frames.npy, and prints a line for each request.
"""

import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapt.rendering.offscreen import Backend, render_environment
from mapt.rendering.renderer import ClipRenderer
from mapt.rendering.settings import CodecSettings, RenderSettings
from mapt.tasks import load_model
from mapt.tasks.registry import TASK_FILES_VARIABLE

CHEETAH = "HalfCheetah-6x1"


class Drawing:
    """Renders in a child process, which starts with the first request."""

    def __init__(self, backend: Backend, folder: Path) -> None:
        self._backend, self._folder = backend, folder
        self._process: subprocess.Popen[str] | None = None

    def frames(
        self, qpos: NDArray[np.float64], agents: list[list[int]], settings: RenderSettings, task: str = CHEETAH
    ) -> NDArray[np.uint8]:
        """Frames (T,H,W,3) of states (T,nq)."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, __file__, str(self._folder)],
                env=render_environment(self._backend),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        np.save(self._folder / "qpos.npy", qpos)
        request = {
            "task": task,
            "agents": agents,
            "settings": asdict(settings),
            "task_files": os.environ.get(TASK_FILES_VARIABLE, ""),
        }
        print(json.dumps(request), file=self._process.stdin, flush=True)
        assert self._process.stdout.readline(), "the child process ended"
        return np.load(self._folder / "frames.npy")

    def close(self) -> None:
        """End the child process; the next request starts another."""
        if self._process is not None:
            self._process.communicate()
            self._process = None


def main() -> None:
    folder = Path(sys.argv[1])
    for line in sys.stdin:
        request = json.loads(line)
        os.environ[TASK_FILES_VARIABLE] = request["task_files"]
        given = request["settings"]
        settings = RenderSettings(**given | {"codec": CodecSettings(**given["codec"])})
        qpos, model = np.load(folder / "qpos.npy"), load_model(request["task"])
        with ClipRenderer(model, request["agents"], settings) as renderer:
            np.save(folder / "frames.npy", np.stack(list(renderer.frames(qpos, np.zeros((len(qpos), model.nv))))))
        print("rendered", flush=True)


if __name__ == "__main__":
    main()
