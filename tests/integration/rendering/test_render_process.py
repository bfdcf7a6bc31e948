"""The render process: its clips, and how it recovers from hangs and crashes."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path

import av
import numpy as np
import psutil
import pytest

from accord.rendering.process import ClipJob, RenderFailed, RenderProcess, RenderTimedOut
from integration.rendering.gaits import trot
from mapt.rendering.offscreen import Backend, render_environment
from mapt.rendering.settings import RenderSettings

#: patience for events that happen soon, on a busy machine
DEADLINE_SECONDS = 60.0


@pytest.fixture(scope="module")
def shared_process(backend: Backend) -> Iterator[RenderProcess]:
    with closing(RenderProcess(backend)) as process:
        yield process


@pytest.fixture
def process(shared_process: RenderProcess) -> RenderProcess:
    """Shared by all tests. Each test leaves a working process."""
    return shared_process


def job(folder: Path, steps: int = 5, task: str = "HalfCheetah-6x1") -> ClipJob:
    qpos = trot(steps)
    return ClipJob(task, qpos, np.zeros_like(qpos), RenderSettings(width=160, height=120), folder / "clip.mp4")


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_SECONDS
    while not condition():
        assert time.monotonic() < deadline, "the condition did not become true in time"
        time.sleep(0.005)


def is_gone(pid: int) -> bool:
    return not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


def size_bytes(path: Path) -> int:
    """Size of a file; 0 if it is gone."""
    return path.stat().st_size if path.exists() else 0


@contextmanager
def signal_while_writing(process: RenderProcess, folder: Path, signal_number: int) -> Iterator[None]:
    """Send a signal to the process while it writes its clip."""
    pid = process.pid

    def send_signal() -> None:
        wait_until(lambda: is_gone(pid) or any(size_bytes(path) for path in folder.glob(f".clip.mp4.{pid}.*")))
        with suppress(ProcessLookupError):
            os.kill(pid, signal_number)

    thread = threading.Thread(target=send_signal)
    thread.start()
    yield
    thread.join()


def assert_renders(process: RenderProcess, folder: Path) -> None:
    clip = process.render(job(folder))
    with av.open(str(clip.path)) as container:
        assert sum(1 for _ in container.decode(video=0)) == clip.frames == 5


@pytest.mark.parametrize("task", ["HalfCheetah-6x1", "HalfCheetah-2x3"])
def test_clip_has_a_frame_for_every_state(process: RenderProcess, tmp_path: Path, task: str) -> None:
    clip = process.render(job(tmp_path, steps=50, task=task))
    assert clip.path == tmp_path / "clip.mp4"
    assert (clip.frames, clip.seconds, clip.width, clip.height) == (50, 2.5, 160, 120)
    with av.open(str(clip.path)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 50
    assert list(tmp_path.iterdir()) == [clip.path]


def test_alternating_settings_each_get_their_size(process: RenderProcess, tmp_path: Path) -> None:
    for width in (160, 96, 128, 112, 144, 176, 160):  # more settings than renderers kept
        settings = RenderSettings(width=width, height=96)
        clip = process.render(replace(job(tmp_path), settings=settings))
        with av.open(str(clip.path)) as container:
            assert container.streams.video[0].codec_context.width == width


@pytest.mark.parametrize(
    ("broken", "cause"),
    [
        ({"task": "Walker-2x3"}, "Walker-2x3"),
        ({"qpos": np.zeros((5, 7))}, "States must have shapes"),
        ({"qvel": np.zeros((4, 9))}, "States must have shapes"),
        ({"qpos": np.full((5, 9), np.nan)}, "diverged"),
        ({"qpos": np.zeros((0, 9)), "qvel": np.zeros((0, 9))}, "at least one state"),
        ({"path": Path("/nowhere/clip.mp4")}, "could not be written"),
    ],
)
def test_failed_job_does_not_affect_the_next(
    process: RenderProcess, tmp_path: Path, broken: dict[str, object], cause: str
) -> None:
    pid = process.pid
    with pytest.raises(RenderFailed) as error:
        process.render(replace(job(tmp_path), **broken))
    assert cause in str(error.value)
    assert list(tmp_path.iterdir()) == []
    assert_renders(process, tmp_path)
    assert process.pid == pid


def test_hung_process_is_killed_and_replaced(process: RenderProcess, tmp_path: Path) -> None:
    assert_renders(process, tmp_path)
    (tmp_path / "clip.mp4").unlink()
    hung = process.pid
    os.kill(hung, signal.SIGSTOP)
    with pytest.raises(RenderTimedOut) as error:
        process.render(job(tmp_path), limit_seconds=0.5)
    assert error.value.code == "render_timed_out"
    assert is_gone(hung)
    assert list(tmp_path.iterdir()) == []
    assert_renders(process, tmp_path)


def test_hung_process_does_not_block_its_parent_with_a_long_job(
    backend: Backend, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("accord.rendering.process.SEND_LIMIT_SECONDS", 1)
    with closing(RenderProcess(backend)) as process:
        hung = process.pid
        assert_renders(process, tmp_path)
        os.kill(hung, signal.SIGSTOP)
        with pytest.raises(RenderTimedOut):  # 7 MB do not fit into the socket's buffer
            process.render(job(tmp_path, steps=50_000), limit_seconds=0.5)
        assert is_gone(hung)
        assert_renders(process, tmp_path)


def test_hang_during_a_clip_leaves_no_file(process: RenderProcess, tmp_path: Path) -> None:
    with signal_while_writing(process, tmp_path, signal.SIGSTOP), pytest.raises(RenderTimedOut):
        process.render(job(tmp_path, steps=20_000), limit_seconds=3)
    assert list(tmp_path.iterdir()) == []
    assert_renders(process, tmp_path)


def test_kill_during_a_clip_leaves_no_file(process: RenderProcess, tmp_path: Path) -> None:
    with signal_while_writing(process, tmp_path, signal.SIGKILL), pytest.raises(RenderFailed) as error:
        process.render(job(tmp_path, steps=20_000))
    assert error.value.code == "render_failed"
    assert "SIGKILL" in str(error.value)
    assert list(tmp_path.iterdir()) == []
    assert_renders(process, tmp_path)


def test_process_killed_between_clips_is_replaced(process: RenderProcess, tmp_path: Path) -> None:
    assert_renders(process, tmp_path)
    killed = process.pid
    os.kill(killed, signal.SIGKILL)
    with pytest.raises(RenderFailed):
        process.render(job(tmp_path))
    assert process.pid != killed
    assert_renders(process, tmp_path)


def test_child_ignores_ctrl_c(process: RenderProcess, tmp_path: Path) -> None:
    assert_renders(process, tmp_path)
    pid = process.pid
    os.kill(pid, signal.SIGINT)
    assert_renders(process, tmp_path)
    assert process.pid == pid
    assert os.getpgid(pid) != os.getpgid(0)  # so the terminal sends it no signal


def test_torch_is_not_loaded(process: RenderProcess, tmp_path: Path) -> None:
    assert_renders(process, tmp_path)
    libraries = Path(f"/proc/{process.pid}/maps").read_text()
    assert "mujoco" in libraries
    assert "torch" not in libraries


def test_close_ends_the_process(backend: Backend, tmp_path: Path) -> None:
    with closing(RenderProcess(backend)) as process:
        assert_renders(process, tmp_path)
    assert is_gone(process.pid)


def test_process_ends_when_its_parent_is_killed(backend: Backend, tmp_path: Path) -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT, backend, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    with parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        wait_until(lambda: any(path.suffix == ".partial" for path in tmp_path.iterdir()))
        parent.kill()
    wait_until(lambda: is_gone(child))
    assert not (tmp_path / "clip.mp4").exists()


#: a parent process that renders a clip for several minutes
PARENT = """
import sys
from pathlib import Path
import numpy as np
from accord.rendering.process import ClipJob, RenderProcess
from mapt.rendering.settings import RenderSettings

process = RenderProcess(sys.argv[1])
print(process.pid, flush=True)
states = np.zeros((50_000, 9))
process.render(ClipJob("HalfCheetah-6x1", states, states, RenderSettings(), Path(sys.argv[2]) / "clip.mp4"))
"""


def test_a_process_whose_parent_has_closed_the_connection_before_it_is_ready_ends_without_a_traceback(
    backend: Backend,
) -> None:
    parent, child = Pipe()
    parent.close()
    with child:
        command = [sys.executable, "-P", "-m", "accord.rendering.child", str(child.fileno()), str(os.getpid())]
        done = subprocess.run(
            command,
            pass_fds=[child.fileno()],
            env=render_environment(backend),
            capture_output=True,
            text=True,
            check=False,
        )
    assert (done.returncode, done.stderr) == (0, "")
