"""The render worker: `python -m accord.workers.render_worker`. Renders the clips that queries need, one at a time."""

import hashlib
import io
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from mujoco import MjModel  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

from accord.domain.enums import WorkerRole
from accord.domain.errors import BlobMissing
from accord.rendering.checks import probe_backend
from accord.rendering.clip_key import clip_key
from accord.rendering.process import ClipJob as DrawJob
from accord.rendering.process import RenderFailed, RenderProcess
from accord.services import clips
from accord.services.clips import ClipJob, MadeClip
from accord.services.collect import drawn_blob_key, load_arrays
from accord.workers.runner import Context, run_worker
from mapt.rendering.encode import ClipFile
from mapt.rendering.settings import RenderSettings
from mapt.tasks import agent_geoms, load_model, task_spec


@dataclass(frozen=True, slots=True)
class _Look:
    """What is the same for all clips of a task."""

    settings: RenderSettings
    #: of the model as it is simulated
    model: MjModel
    agents: tuple[tuple[int, ...], ...]


class RenderWorker:
    """Makes clips in a process of its own, which it replaces when it hangs."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._process: RenderProcess | None = None
        self._looks: dict[str, _Look] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="accord-clips-")

    def work(self) -> bool:
        """Make the clip that is wanted soonest.

        Raises:
            RenderingUnavailable: if this machine cannot draw; looked for again at every try.
        """
        process = self._ready_process()
        context = self._context
        with context.database.transaction() as session:
            job = clips.claim_pending(session, context.holder, context.settings.worker_lease_seconds)
        if job is None:
            return False
        context.pulse.say("working", f"clip of {job.task}")
        lease = context.settings.worker_lease_seconds
        with context.pulse.keep(
            job.clip_id, lambda session: clips.heartbeat(session, job.clip_id, context.holder, lease)
        ):
            self._make(process, job)
        return True

    def close(self) -> None:
        if self._process:
            self._process.close()
        self._folder.cleanup()

    def _ready_process(self) -> RenderProcess:
        if self._process is None:
            # Started before there is anything to draw, so that the first clip does not wait for OpenGL.
            self._process = RenderProcess(probe_backend(), self._context.settings.render_timeout_seconds)
        return self._process

    def _make(self, process: RenderProcess, job: ClipJob) -> None:
        """Draw, store, then say so: the row comes after the blob."""
        try:
            made = self._draw_and_store(process, job)
        except RenderFailed as error:
            # The segment's own fault, as like as not: others are made meanwhile.
            with self._context.database.transaction() as session:
                clips.fail(session, job.clip_id, str(error), retry=True)
            return
        with self._context.database.transaction() as session:
            clips.finish(session, job.clip_id, made)

    def _draw_and_store(self, process: RenderProcess, job: ClipJob) -> MadeClip:
        if task_spec(job.task).nq == 0:
            return self._drawn(job)
        arrays = load_arrays(self._context.blobs, job.segment_blob_key)
        look = self._look(job.task)
        qpos, qvel = (arrays[name].astype(np.float64, copy=False) for name in ("qpos", "qvel"))
        key = clip_key(qpos, qvel, look.model, look.agents, look.settings)
        path = Path(self._folder.name) / f"{job.clip_id}.mp4"
        clip: ClipFile = process.render(DrawJob(job.task, qpos, qvel, look.settings, path))
        blob_key = f"clips/{key[:2]}/{key}.mp4"
        try:
            content = path.read_bytes()
        finally:
            path.unlink()
        self._context.blobs.put(blob_key, content)
        return MadeClip(
            cache_key=key,
            blob_key=blob_key,
            # Of the blob: bytes differ from run to run, and a key that was there keeps its first ones.
            size_bytes=self._context.blobs.size(blob_key),
            frames=clip.frames,
            seconds=clip.seconds,
            width=clip.width,
            height=clip.height,
        )

    def _drawn(self, job: ClipJob) -> MadeClip:
        """The clip that the task drew of itself while the segment was played.

        Raises:
            RenderFailed: if it is not there, or is no clip.
        """
        key = drawn_blob_key(job.segment_blob_key)
        try:
            content = self._context.blobs.read(key)
            with av.open(io.BytesIO(content)) as container:
                video = container.streams.video[0]
                frames, width, height = video.frames, video.width, video.height
        except (BlobMissing, FFmpegError) as error:
            raise RenderFailed(f"{job.task} draws itself, and drew no clip of this segment: {error}") from error
        return MadeClip(
            cache_key=hashlib.sha256(content).hexdigest(),
            blob_key=key,
            size_bytes=len(content),
            frames=frames,
            seconds=frames * task_spec(job.task).step_seconds,
            width=width,
            height=height,
        )

    def _look(self, task: str) -> _Look:
        if task not in self._looks:
            settings = RenderSettings(frame_rate_hz=1.0 / task_spec(task).step_seconds)
            self._looks[task] = _Look(settings, load_model(task), agent_geoms(task))
        return self._looks[task]


if __name__ == "__main__":
    sys.exit(run_worker(WorkerRole.RENDER, RenderWorker, sys.argv[1:]))
