"""Clips per second of a render process, with two upper bounds measured in the same run.

`same picture` calls the renderer and the encoder directly, without a render process. `bare loop` is a minimal loop from
states to an mp4 with MuJoCo and PyAV: the original model and camera, cheapest scene flags, no shadows, overlays or
smoothed camera. All alternate clip by clip, so that other load slows them equally.

    python tests/benchmarks/bench_clips.py [clips]
    python tests/benchmarks/bench_clips.py --settings [clips]

With `--settings`, it prints the CPU seconds and kilobytes of a clip for several sizes and qualities, and with the
settings before version 4 of the renderer (448x336, fast).
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import av
import mujoco
import numpy as np

from accord.rendering.checks import probe_backend
from accord.rendering.process import ClipJob, RenderProcess
from mapt.rendering.encode import write_clip
from mapt.rendering.offscreen import Backend, render_environment
from mapt.rendering.renderer import ClipRenderer
from mapt.rendering.settings import RenderSettings
from mapt.tasks import agent_geoms, load_model

TASK = "HalfCheetah-6x1"
STEPS = 50
SETTINGS = RenderSettings()
TARGET = 0.9


def states() -> np.ndarray:
    """(2,T,9): qpos and qvel of a cheetah with sinusoidal controls, from step 20."""
    model = load_model(TASK)
    data = mujoco.MjData(model)
    rows = []
    for step in range(20 + STEPS):
        data.ctrl[:] = 0.8 * np.sin(0.6 * step + np.arange(model.nu))
        mujoco.mj_step(model, data, 5)
        rows.append([data.qpos.copy(), data.qvel.copy()])
    return np.array(rows[20:]).swapaxes(0, 1)


def bare_loop(folder: Path) -> Callable[[], None]:
    """A minimal loop without Accord's code."""
    qpos, qvel = np.load(folder / "states.npy")
    model = load_model(TASK)
    quality = model.vis.quality
    quality.offsamples, quality.shadowsize = 4, 0  # anti-aliasing as in clips
    quality.numslices, quality.numstacks, quality.numquads = 12, 6, 1
    data = mujoco.MjData(model)
    renderer = mujoco.Renderer(model, SETTINGS.height, SETTINGS.width)
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        renderer.scene.flags[flag] = False

    def make() -> None:
        with av.open(str(folder / "bare.mp4"), "w", options={"movflags": "+faststart"}) as container:
            stream = container.add_stream("libx264", 20, options={"preset": "veryfast", "crf": "23"})
            stream.width, stream.height, stream.pix_fmt = SETTINGS.width, SETTINGS.height, "yuv420p"
            stream.codec_context.thread_count = 1
            for row in range(STEPS):
                data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, "track")
                container.mux(stream.encode(av.VideoFrame.from_ndarray(renderer.render())))
            container.mux(stream.encode())

    return make


def same_picture(folder: Path) -> Callable[[], None]:
    """The renderer and encoder of the render process, called directly."""
    qpos, qvel = np.load(folder / "states.npy")
    renderer = ClipRenderer(load_model(TASK), agent_geoms(TASK), SETTINGS)
    return lambda: write_clip(renderer.frames(qpos, qvel), folder / "same.mp4", SETTINGS) and None


UPPER_BOUNDS = {"bare loop": bare_loop, "same picture": same_picture}


def serve_upper_bound(name: str, folder: Path) -> None:
    """In a child process: make one clip per line of input."""
    make = UPPER_BOUNDS[name](folder)
    for _ in sys.stdin:
        make()
        print("made", flush=True)


@contextmanager
def upper_bound(name: str, folder: Path, backend: Backend) -> Iterator[Callable[[], None]]:
    """Run an upper bound in a child process with OpenGL."""
    child = subprocess.Popen(
        [sys.executable, __file__, "--upper-bound", name, str(folder)],
        env=render_environment(backend),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )

    def make() -> None:
        assert child.stdin is not None
        assert child.stdout is not None
        print("make", file=child.stdin, flush=True)
        if child.stdout.readline() != "made\n":
            raise SystemExit(f"the {name} failed")

    with child:
        yield make


def alternating(makers: dict[str, Callable[[], None]], clips: int) -> dict[str, float]:
    """Clips per second of each, alternating clip by clip, after a warm-up clip."""
    seconds = dict.fromkeys(makers, 0.0)
    for turn in range(clips + 1):
        for name, make in makers.items():
            start = time.perf_counter()
            make()
            if turn:
                seconds[name] += time.perf_counter() - start
    return {name: clips / spent for name, spent in seconds.items()}


def in_parallel(processes: list[RenderProcess], job: Callable[[int], ClipJob], clips: int) -> float:
    """Clips per second of all processes in parallel."""

    def work(number: int) -> None:
        for _ in range(clips):
            processes[number].render(job(number))

    start = time.perf_counter()
    with ThreadPoolExecutor(len(processes)) as pool:
        list(pool.map(work, range(len(processes))))
    return len(processes) * clips / (time.perf_counter() - start)


def compare_settings(folder: Path, clips: int) -> None:
    """In a child process with OpenGL: print the cost of clips of several sizes and qualities, alternating."""
    qpos, qvel = np.load(folder / "states.npy")
    candidates = [
        RenderSettings(width, height, quality=quality)
        for width, height, quality in (
            (448, 336, "fast"),
            (640, 480, "fast"),
            (640, 480, "smooth"),
            (640, 480, "pretty"),
            (896, 672, "fast"),
        )
    ]
    renderers = [ClipRenderer(load_model(TASK), agent_geoms(TASK), settings) for settings in candidates]
    seconds, sizes = np.zeros((2, len(candidates)))
    for turn in range(clips + 1):
        for number, (renderer, settings) in enumerate(zip(renderers, candidates, strict=True)):
            start = time.process_time()
            clip = write_clip(renderer.frames(qpos, qvel), folder / "compared.mp4", settings)
            if turn:  # the first one opens the OpenGL context
                seconds[number] += time.process_time() - start
                sizes[number] = clip.size_bytes
    for settings, spent, size in zip(candidates, seconds / clips, sizes, strict=True):
        name = f"{settings.width}x{settings.height} {settings.quality}"
        print(f"{name:>16}: {spent:.2f} CPU seconds, {size / 1024:.0f} KB a clip")


def main(clips: int) -> None:
    backend = probe_backend()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        np.save(folder / "states.npy", states())
        qpos, qvel = np.load(folder / "states.npy")

        def job(number: int) -> ClipJob:
            return ClipJob(TASK, qpos, qvel, SETTINGS, folder / f"{number}.mp4")

        first, second = (stack.enter_context(closing(RenderProcess(backend))) for _ in range(2))
        makers = {name: stack.enter_context(upper_bound(name, folder, backend)) for name in UPPER_BOUNDS}
        rates = alternating({**makers, "render process": lambda: first.render(job(0)) and None}, clips)
        second.render(job(1))
        two = in_parallel([first, second], job, clips)
        kilobytes = (folder / "0.mp4").stat().st_size / 1024
    size = f"{SETTINGS.width}x{SETTINGS.height}"
    print(f"{clips} clips each of {STEPS} frames, {size}, {SETTINGS.quality}, {backend}; {kilobytes:.0f} KB per clip")
    for name, rate in rates.items():
        print(f"{name:>20}: {rate:6.2f} clips/s")
    print(f"{'two processes':>20}: {two:6.2f} clips/s, {two / rates['render process']:.2f} times one")
    for name in UPPER_BOUNDS:
        print(f"render process / {name}: {rates['render process'] / rates[name]:.0%} (target {TARGET:.0%})")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--upper-bound"]:
        serve_upper_bound(sys.argv[2], Path(sys.argv[3]))
    elif sys.argv[1:2] == ["--compare"]:
        compare_settings(Path(sys.argv[2]), int(sys.argv[3]))
    elif sys.argv[1:2] == ["--settings"]:
        with tempfile.TemporaryDirectory() as folder:
            np.save(Path(folder) / "states.npy", states())
            command = [sys.executable, __file__, "--compare", folder, (sys.argv[2:] or ["5"])[0]]
            subprocess.run(command, env=render_environment(probe_backend()), check=True)
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
