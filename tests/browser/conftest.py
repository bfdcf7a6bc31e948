"""Fixtures for tests in real Chromium against the real service: page, API, workers, and clips rendered by EGL.

The browser and the service stop after the last test of this folder. Playwright keeps an event loop open in this thread,
which prevents other tests from starting theirs, and the workers of the service would slow down later tests.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, expect, sync_playwright

from accord.api.pages import FOLDER
from browser.fixture_types import NewExperiment, SignIn
from browser.labeller import PATIENCE_MS
from browser.service import SMALL, Service
from support.chromium import chromium
from support.ci import IN_CI

#: the service, once it was started
_SERVICE = pytest.StashKey[Service]()
#: ids of the experiments and users before the first attempt of a test
_EXISTING = pytest.StashKey[set[str]]()
_FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """In CI, a test that fails in a browser is run again, once: the report lists it, and one race stops no change."""
    for item in items:
        if IN_CI and Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.flaky(reruns=1))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Before a second attempt, free the names of what the first one created: the service goes on between them."""
    service = item.session.stash.get(_SERVICE, None)
    if service is None or not service.is_alive():
        return
    if getattr(item, "execution_count", 1) == 1:
        item.stash[_EXISTING] = service.named()
    else:
        service.free_names(item.stash.get(_EXISTING, set()))


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    program = chromium()
    if program is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    # On a busy machine the page can take longer than Playwright's default of 5 s.
    expect.set_options(timeout=PATIENCE_MS)
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=program, args=list(_FLAGS))
        yield launched
        launched.close()


@pytest.fixture(scope="package")
def service(
    tmp_path_factory: pytest.TempPathFactory, browser: Browser, request: pytest.FixtureRequest
) -> Iterator[Service]:
    """A running service. Depends on `browser`, so that a test skipped without a browser does not start the service."""
    if not (FOLDER / "index.html").is_file():
        pytest.skip("the page is not built: python frontend/build_page.py")
    service = Service(tmp_path_factory.mktemp("accord"))
    service.start()
    request.session.stash[_SERVICE] = service
    yield service
    service.stop()


@pytest.fixture(scope="package")
def researcher(service: Service) -> str:
    """A researcher's bearer token."""
    return service.add_user("Rosa", "researcher")[0]


@pytest.fixture
def new_experiment(service: Service, researcher: str) -> Iterator[NewExperiment]:
    """Starts experiments and cancels them after the test, so that the next test has all workers."""
    yield from _cancelled_afterwards(service, researcher)


@pytest.fixture(scope="module")
def new_shared_experiment(service: Service, researcher: str) -> Iterator[NewExperiment]:
    """Starts experiments that several tests of a module use, and cancels them after its last test."""
    yield from _cancelled_afterwards(service, researcher)


def _cancelled_afterwards(service: Service, researcher: str) -> Iterator[NewExperiment]:
    created: list[str] = []
    with service.api(researcher) as api:

        def start(name: str, **changes: Any) -> str:
            response = api.post("/experiments", json=SMALL | {"name": name} | changes)
            assert response.status_code == 201, response.text
            created.append(response.json()["id"])
            return created[-1]

        yield start
        for experiment_id in created:
            api.post(f"/experiments/{experiment_id}/cancel")


@pytest.fixture
def sign_in(service: Service, browser: Browser, request: pytest.FixtureRequest) -> Iterator[SignIn]:
    """Signs each new user in, in a separate browser context; returns a page that loads the list of experiments.

    After a failed test, saves a screenshot of every page in the service's home.
    """
    contexts = []
    failed_before = request.session.testsfailed
    refused: list[str] = []

    def enter(name: str, role: str = "labeller", **options: Any) -> Page:
        _, link = service.add_user(f"{name} of {request.node.name}"[:100], role)
        context = browser.new_context(viewport={"width": 1280, "height": 800}, **options)
        contexts.append(context)
        assert context.request.post(link.replace("/sign-in/", "/api/v1/sign-in/")).ok
        context.on("console", lambda message: _note_violation(message, refused))
        page = context.new_page()
        # Most tests open another page at once, and need not wait for this one.
        page.goto(service.url, wait_until="commit")
        return page

    yield enter
    for number, context in enumerate(contexts):
        for page in context.pages if request.session.testsfailed > failed_before else []:
            page.screenshot(path=Path(service.home) / f"{request.node.name}-{number}.png")
        context.close()
    assert refused == [], "the page does not obey its own content security policy"


def _note_violation(message: ConsoleMessage, refused: list[str]) -> None:
    if "Content Security Policy" in message.text:
        refused.append(message.text)
