"""A real Chromium before the real service: page, API and worker processes, clips rendered by EGL.

Browser and service end with each module: Playwright keeps an event loop open in this thread, in which no other test
could run one of its own, and the service's workers would train beside every test that follows.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from accord.api.pages import FOLDER
from browser.fixture_types import NewExperiment, SignIn
from browser.labeller import PATIENCE_MS
from browser.service import SMALL, Service

_FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    # What is expected happens at once or never, but on a busy machine at once takes longer than the usual 5 s.
    expect.set_options(timeout=PATIENCE_MS)
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=chromium, args=list(_FLAGS))
        yield launched
        launched.close()


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Service]:
    """Not without a browser: the tests would be skipped, and starting it takes the machine for a while."""
    if not (FOLDER / "index.html").is_file():
        pytest.skip("the page is not built: python frontend/build_page.py")
    service = Service(tmp_path_factory.mktemp("accord"))
    service.start()
    yield service
    service.stop()


@pytest.fixture(scope="module")
def researcher(service: Service) -> str:
    """A researcher's bearer token."""
    return service.add_user("Rosa", "researcher")[0]


@pytest.fixture
def new_experiment(service: Service, researcher: str) -> Iterator[NewExperiment]:
    """Starts an experiment, and cancels it after the test, so that the next one has the workers to itself."""
    made: list[str] = []
    with service.api(researcher) as api:

        def start(name: str, **changes: Any) -> str:
            answer = api.post("/experiments", json=SMALL | {"name": name} | changes)
            assert answer.status_code == 201, answer.text
            made.append(answer.json()["id"])
            return made[-1]

        yield start
        for experiment_id in made:
            api.post(f"/experiments/{experiment_id}/cancel")


@pytest.fixture
def sign_in(service: Service, browser: Browser, request: pytest.FixtureRequest) -> Iterator[SignIn]:
    """Opens a browser of its own for a new user. A failed test leaves a picture of it beside pytest's other files."""
    contexts = []

    def enter(name: str, role: str = "labeller", **options: Any) -> Page:
        _, link = service.add_user(f"{name} of {request.node.name}"[:100], role)
        context = browser.new_context(viewport={"width": 1280, "height": 800}, **options)
        contexts.append(context)
        page = context.new_page()
        page.goto(link)
        page.get_by_role("heading", name="Experiments").wait_for()
        return page

    yield enter
    for number, context in enumerate(contexts):
        for page in context.pages:
            page.screenshot(path=Path(service.home) / f"{request.node.name}-{number}.png")
        context.close()
