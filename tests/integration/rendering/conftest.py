"""A rendering backend, or a skip that says what to install."""

from collections.abc import Iterator

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


@pytest.fixture(scope="module")
def drawing(backend: Backend, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Drawing]:
    drawing = Drawing(backend, tmp_path_factory.mktemp("drawing"))
    yield drawing
    drawing.close()
