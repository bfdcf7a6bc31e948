"""Worker processes that make cells: each has one torch thread, and ends with its parent."""

import multiprocessing
import os
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path

import torch

from mapt.rewards.checkpoints import save_reward_model
from mapt.rewards.trainer import TrainedReward
from mapt.studies.cell import CellSettings, run_cell
from mapt.studies.cell_folder import CellFolder, code_fingerprint
from mapt.studies.replay import Replay

# Threads of OpenMP spin while they wait; with several workers on few cores that costs most of the time.
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
_SPAWN = multiprocessing.get_context("spawn")
_END_SECONDS = 10.0


@dataclass(frozen=True, slots=True)
class Job:
    """A cell to make."""

    settings: CellSettings
    #: folder of the replay it is made from
    replay: Path
    #: where the trained model is kept; None lets it go
    model: Path | None = None


@dataclass(frozen=True, slots=True)
class Done:
    """What became of a job."""

    job: Job
    #: why it failed; None where the cell was made
    failure: str | None = None


@dataclass(slots=True)
class _Worker:
    process: SpawnProcess
    connection: Connection
    job: Job | None = None


def run_jobs(jobs: Sequence[Job], cells: Path, n_workers: int, started: Callable[[Job], None]) -> Iterator[Done]:
    """Make the cells of `jobs`, in that order, into the folder `cells`; yields each as it is done.

    A worker that dies fails its own cell alone; another takes its place.

    Args:
        started: called when a worker takes a job.
    """
    waiting = list(reversed(jobs))
    workers = [_start(cells) for _ in range(min(n_workers, len(jobs)))]
    try:
        while True:
            for worker in workers:
                if worker.job is None and waiting:
                    worker.job = waiting.pop()
                    started(worker.job)
                    _send(worker)
            busy = [worker for worker in workers if worker.job is not None]
            if not busy:
                return
            ready = wait([worker.connection for worker in busy])
            for worker in busy:
                if worker.connection in ready and worker.job is not None:
                    job, failure = worker.job, _receive(worker)
                    worker.job = None
                    if not worker.process.is_alive() and waiting:
                        workers[workers.index(worker)] = _start(cells)
                    yield Done(job, failure)
    finally:
        for worker in workers:
            worker.connection.close()
            if worker.job is not None:
                worker.process.terminate()
        for worker in workers:
            worker.process.join(_END_SECONDS)


def _start(cells: Path) -> _Worker:
    ours, theirs = _SPAWN.Pipe()
    process = _SPAWN.Process(target=_work, args=(theirs, cells, os.getpid()), daemon=True)
    with _environment():
        process.start()
    theirs.close()
    return _Worker(process, ours)


def _send(worker: _Worker) -> None:
    try:
        worker.connection.send(worker.job)
    except (BrokenPipeError, ConnectionResetError):
        # It died while idle; what `wait` finds at its end of the pipe says so.
        return


def _receive(worker: _Worker) -> str | None:
    try:
        return worker.connection.recv()
    except (EOFError, ConnectionResetError):
        worker.process.join(_END_SECONDS)
        return f"its worker process died (exit status {worker.process.exitcode})"


@contextmanager
def _environment() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _keep(folder: Path | None, segment_steps: int, trained: TrainedReward) -> None:
    if folder is not None:
        save_reward_model(trained.model, trained.metrics, segment_steps=segment_steps).write(folder)


def _work(connection: Connection, cells: Path, parent: int) -> None:
    """The life of a worker: jobs in, None or a sentence on what went wrong out."""
    torch.set_num_threads(1)
    folder, code = CellFolder(cells), code_fingerprint()

    def orphaned() -> bool:
        return os.getppid() != parent

    while True:
        try:
            job: Job = connection.recv()
        except (EOFError, KeyboardInterrupt):
            return
        try:
            replay = Replay.open(job.replay)
            keep = partial(_keep, job.model, replay.source.n_steps)
            result = run_cell(job.settings, replay, orphaned, keep)
        except KeyboardInterrupt:
            return
        except Exception as error:  # noqa: BLE001  (one cell's failure must not take the others with it)
            where = traceback.extract_tb(error.__traceback__)[-1]
            connection.send(f"{type(error).__name__}: {error} ({Path(where.filename).name}, line {where.lineno})")
            continue
        if result is None:
            return
        folder.write(job.settings, result, code)
        connection.send(None)
