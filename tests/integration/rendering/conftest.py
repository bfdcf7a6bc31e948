"""A rendering backend, or a skip that says what to install."""

from pathlib import Path

import pytest

from accord.rendering.checks import probe_backend
from accord.rendering.process import RenderingUnavailable
from integration.rendering.drawing import Drawing
from mapt.rendering.offscreen import Backend


@pytest.fixture(scope="session")
def backend() -> Backend:
    try:
        return probe_backend()
    except RenderingUnavailable as error:
        pytest.skip(str(error))


@pytest.fixture
def drawing(backend: Backend, tmp_path: Path) -> Drawing:
    return Drawing(backend, tmp_path)
