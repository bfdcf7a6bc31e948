"""The checks of rendering and encoding."""

import os
import sys
from pathlib import Path

import pytest

from accord.rendering import checks
from accord.rendering.checks import check_encoder, check_rendering, probe_backend, try_backend
from accord.rendering.process import RenderingUnavailable
from mapt.rendering.offscreen import Backend, render_environment


def test_checks_pass_on_this_machine(backend: Backend) -> None:
    assert check_rendering().ok
    assert backend in check_rendering().detail
    assert check_encoder().ok
    assert check_encoder().fix is None


def test_without_opengl_the_check_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "BACKENDS", ("glfw",))  # needs a display, and there is none
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RenderingUnavailable) as error:
        probe_backend()
    assert error.value.code == "rendering_unavailable"
    assert "glfw: " in str(error.value)
    assert "libegl1 libgl1" in str(error.value)
    check = check_rendering()
    assert not check.ok
    assert check.fix == checks.INSTALL
    assert checks.INSTALL not in check.detail


def test_hung_backend_times_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sleeper = tmp_path / "python"
    sleeper.write_text("#!/bin/sh\nexec sleep 600\n")
    sleeper.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(sleeper))
    assert try_backend("egl", timeout_seconds=0.2) == "timed out after 0.2 seconds"


def test_render_environment_extends_the_environment_of_this_process() -> None:
    environment = render_environment("osmesa")
    assert environment["MUJOCO_GL"] == environment["PYOPENGL_PLATFORM"] == "osmesa"
    assert environment["LP_NUM_THREADS"] == "0"
    assert environment["PATH"] == os.environ["PATH"]
