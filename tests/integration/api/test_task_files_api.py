"""A file of tasks that fails is a sentence of the API, whatever is asked."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from accord.api import responses
from mapt.tasks import registry
from support.api_in_thread import ApiServer

NEW = {"name": "one", "task": "Tug-2x1"}


@pytest.fixture
def no_views_kept() -> Iterator[None]:
    responses.task_response.cache_clear()
    yield
    responses.task_response.cache_clear()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "FileNotFoundError"),
        ("import not_installed_here", "not_installed_here"),
        ("def half(:", "SyntaxError"),
        ("from mapt.tasks import register_task\nregister_task(1 / 0)", "division by zero"),
    ],
)
@pytest.mark.parametrize("ask", ["list", "create"])
def test_a_task_file_that_fails_is_named_in_a_sentence(
    api: ApiServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str | None, words: str, ask: str
) -> None:
    file = tmp_path / "broken_tasks.py"
    if content is not None:
        file.write_text(content)
    monkeypatch.setenv("MAPT_TASKS", str(file))
    client = api.researcher
    response = client.get("/api/v1/tasks") if ask == "list" else client.post("/api/v1/experiments", json=NEW)
    assert response.status_code == 503
    assert response.headers["content-type"] == "application/json"
    error = response.json()["error"]
    assert error["code"] == "task_unavailable"
    for part in ("MAPT_TASKS", str(file), words, "start Accord again"):
        assert part in error["message"]
    assert "Traceback" not in response.text
    assert api.anyone.get("/api/v1/health").status_code == 200


def test_a_mended_file_is_read_again(api: ApiServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "mended_tasks.py"
    file.write_text("raise RuntimeError('not yet')")
    monkeypatch.setenv("MAPT_TASKS", str(file))
    assert api.researcher.get("/api/v1/tasks").status_code == 503
    file.write_text("")
    assert api.researcher.get("/api/v1/tasks").status_code == 200


def test_an_experiment_whose_task_is_no_longer_known_is_a_sentence_too(
    api: ApiServer, no_views_kept: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = registry._ENTRIES
    made = api.researcher.post("/api/v1/experiments", json=NEW | {"task": "HalfCheetah-6x1"})
    assert made.status_code == 201, made.text
    responses.task_response.cache_clear()
    monkeypatch.delitem(entries, "HalfCheetah-6x1")
    response = api.researcher.get(f"/api/v1/experiments/{made.json()['id']}")
    assert response.status_code == 503
    assert "HalfCheetah-6x1" in response.json()["error"]["message"]
