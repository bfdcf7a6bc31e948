"""Clips of tasks that draw themselves, made while the policy worker still knows how their segments came about.

Nothing can be drawn from such a task's states later. So the rollout is played again, from the snapshot before it and by
its own actions, and what became segments is drawn on the way: nothing is drawn that nobody asked for.
"""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from accord.services.collect import drawn_blob_key
from accord.store.blobs import BlobStore
from mapt.errors import NoSimulator, UnusableEnvironment
from mapt.policies import Rollout
from mapt.preferences.segments import StepRange
from mapt.rendering.encode import open_clip
from mapt.rendering.settings import RenderSettings
from mapt.tasks import RenderableTask, Task, make_task


def draws_itself(task: Task) -> bool:
    """Whether clips of this task must be drawn by itself.

    Raises:
        NoSimulator: if it has no states to draw from, and does not draw itself either.
    """
    if task.spec.nq > 0:
        return False
    if not isinstance(task, RenderableTask):
        raise NoSimulator(task.spec.name)
    return True


class Redrawing:
    """Plays a rollout again and draws parts of it.

    Args:
        before: snapshot of the task before the rollout.
    """

    def __init__(self, task: Task, before: Mapping[str, np.ndarray], rollout: Rollout) -> None:
        self._spec, self._n_envs = task.spec, task.n_envs
        self._before, self._rollout = dict(before), rollout

    def store(self, blobs: BlobStore, places: Sequence[StepRange], segment_blob_keys: Sequence[str]) -> None:
        """Put a clip beside each segment's blob.

        Args:
            places: of the segments, in the order of their keys.

        Raises:
            NotRenderable: if the task draws nothing.
            UnusableEnvironment: if it does not play again as it did.
            ClipNotWritten: if its pictures change in size, or cannot be encoded.
        """
        with tempfile.TemporaryDirectory(prefix="accord-drawn-") as folder:
            paths = {place: Path(folder) / f"{number}.mp4" for number, place in enumerate(places)}
            # The team's own options do not matter: actions are given, and nothing is observed.
            task = make_task(self._spec.name, self._n_envs)
            try:
                task.restore(self._before)
                assert isinstance(task, RenderableTask)
                self._draw(task, paths)
            finally:
                task.close()
            for place, key in zip(places, segment_blob_keys, strict=True):
                blobs.put(drawn_blob_key(key), paths[place].read_bytes())

    def _draw(self, task: RenderableTask, paths: Mapping[StepRange, Path]) -> None:
        settings = self._settings(even(task.render(0)))
        with ExitStack() as unfinished:
            writing: dict[int, tuple[Callable[[NDArray[np.uint8]], None], ExitStack, int]] = {}
            for step in range(max((place.end for place in paths), default=0)):
                for place, path in paths.items():
                    if place.first == step:
                        clip = unfinished.enter_context(ExitStack())
                        add = clip.enter_context(open_clip(path, settings))
                        writing[place.env] = add, clip, place.end
                for env, (add, clip, end) in list(writing.items()):
                    add(even(task.render(env)))
                    if step + 1 == end:
                        clip.close()
                        del writing[env]
                rewards = task.step(self._rollout.actions[step]).reward
                if not np.array_equal(rewards, self._rollout.rewards[step]):
                    raise UnusableEnvironment(
                        f"{self._spec.name} does not follow from its seed and its actions: played again, it gave other "
                        "rewards, so no clip of it can be drawn. Let every chance in it come from reset's seed."
                    )

    def _settings(self, picture: NDArray[np.uint8]) -> RenderSettings:
        height, width, _ = picture.shape
        return RenderSettings(width=width, height=height, frame_rate_hz=1.0 / self._spec.step_seconds)


def even(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture (H,W,3) with its last row or column doubled where their number is odd: a codec needs even ones."""
    height, width, _ = picture.shape
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
