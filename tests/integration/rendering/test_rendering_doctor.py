"""What a machine is told about itself."""

import os
import sys
from pathlib import Path

import pytest

from accord.rendering import checks as probe
from accord.rendering.checks import check_encoder, check_rendering, probe_backend, try_backend
from accord.rendering.process import RenderingUnavailable
from mapt.rendering.offscreen import Backend, render_environment


def test_this_machine_can_draw_and_encode(backend: Backend) -> None:
    assert check_rendering().ok
    assert backend in check_rendering().detail
    assert check_encoder().ok
    assert check_encoder().fix is None


def test_machine_without_opengl_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "BACKENDS", ("glfw",))  # needs a display, and here is none
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RenderingUnavailable, match=r"glfw: .+libegl1 libgl1") as error:
        probe_backend()
    assert error.value.code == "rendering_unavailable"
    check = check_rendering()
    assert not check.ok
    assert check.fix == probe.INSTALL


def test_backend_that_hangs_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sleeper = tmp_path / "python"
    sleeper.write_text("#!/bin/sh\nexec sleep 600\n")
    sleeper.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(sleeper))
    assert try_backend("egl", limit_seconds=0.2) == "no frame in 0.2 seconds"


def test_drawing_process_gets_its_environment_and_keeps_the_rest() -> None:
    environment = render_environment("osmesa")
    assert environment["MUJOCO_GL"] == environment["PYOPENGL_PLATFORM"] == "osmesa"
    assert environment["LP_NUM_THREADS"] == "0"
    assert environment["PATH"] == os.environ["PATH"]
