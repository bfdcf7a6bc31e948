"""What a render process and its parent say to each other: JSON, and arrays as their bytes. No pickle.

parent -> child   a job: header, qpos, qvel
child -> parent   "ready" once; then for each job "done" with the clip, or "failed" with a sentence
"""

import json
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapt.rendering.encode import ClipFile
from mapt.rendering.settings import CodecSettings, RenderSettings


@dataclass(frozen=True, slots=True)
class ClipJob:
    """One clip to make."""

    #: a name that `mapt.tasks` knows
    task: str
    #: simulator states, float64 (T,nq) and (T,nv)
    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]
    settings: RenderSettings
    #: where the clip goes; its folder exists
    path: Path


@dataclass(frozen=True, slots=True)
class Reply:
    """What a child answers: exactly one of the two, or neither when it is ready."""

    clip: ClipFile | None = None
    failure: str | None = None


def send_job(connection: Connection, job: ClipJob) -> None:
    """Hand a job over.

    Raises:
        OSError: if the child is gone.
    """
    header = {
        "task": job.task,
        "settings": asdict(job.settings),
        "path": str(job.path.resolve()),
        "shapes": [job.qpos.shape, job.qvel.shape],
    }
    connection.send_bytes(json.dumps(header).encode())
    for states in (job.qpos, job.qvel):
        connection.send_bytes(np.ascontiguousarray(states, dtype="<f8").tobytes())


def receive_job(connection: Connection) -> ClipJob:
    """Wait for the next job.

    Raises:
        EOFError: if the parent has closed the connection or is gone.
    """
    header = json.loads(connection.recv_bytes())
    qpos, qvel = (np.frombuffer(connection.recv_bytes(), "<f8").reshape(shape) for shape in header["shapes"])
    return ClipJob(header["task"], qpos, qvel, _settings(header["settings"]), Path(header["path"]))


def send_reply(connection: Connection, reply: Reply) -> None:
    clip = reply.clip and asdict(reply.clip) | {"path": str(reply.clip.path)}
    connection.send_bytes(json.dumps({"clip": clip, "failure": reply.failure}).encode())


def receive_reply(connection: Connection) -> Reply:
    """Wait for the child's answer.

    Raises:
        EOFError: if the child is gone.
    """
    fields = json.loads(connection.recv_bytes())
    clip = fields["clip"] and ClipFile(**fields["clip"] | {"path": Path(fields["clip"]["path"])})
    return Reply(clip, fields["failure"])


def _settings(fields: dict[str, Any]) -> RenderSettings:
    codec = CodecSettings(**fields.pop("codec"))
    return RenderSettings(**fields, codec=codec)
