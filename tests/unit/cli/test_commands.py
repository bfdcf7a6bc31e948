import subprocess
import sys
from pathlib import Path

import pytest

from accord.cli.main import app, main
from accord.cli.options import load_settings, service_url, url_of
from accord.cli.up import environment_of
from accord.domain.errors import DatabaseTooNew
from accord.settings import Settings
from support.reference import commands_of

COMMANDS = commands_of(app, "accord")


def test_the_commands_are_those_of_the_documents():
    assert set(COMMANDS) == {
        "accord up",
        "accord link",
        "accord teach",
        "accord demo",
        "accord doctor",
        "accord export",
        "accord tasks",
        "accord user add",
        "accord user link",
        "accord user list",
        "accord user remove",
    }


@pytest.mark.parametrize("module", ["accord.cli.main", "accord.cli.serve"])
def test_commands_and_server_start_without_torch_and_matplotlib(module):
    # They take longer to import than most commands take to run. The import rules do not see what a package's
    # __init__.py brings along.
    program = f"import sys, {module}; print({{'torch', 'matplotlib'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == "set()"


def test_an_error_of_ours_is_one_sentence_and_status_2(monkeypatch, capsys):
    def fail() -> None:
        raise DatabaseTooNew("The database [x] is too new.")

    monkeypatch.setattr(sys.modules["accord.cli.main"], "app", fail)
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    assert capsys.readouterr().err == "accord: The database [x] is too new.\n"


def test_children_read_the_same_settings_from_their_environment(monkeypatch, tmp_path):
    settings = Settings(home=tmp_path / "home", port=1234, poll_seconds=0.125, public_url="https://a.example")
    for name, value in environment_of(settings).items():
        monkeypatch.setenv(name, value)
    assert Settings() == settings


def test_tasks_are_listed_in_lines_of_equal_columns(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["accord", "tasks"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    heading, *lines = capsys.readouterr().out.splitlines()
    assert heading.split() == ["task", "N", "C", "A", "horizon", "state", "step,", "s"]
    assert {len(line) for line in lines} == {len(heading)}
    assert ["HalfCheetah-6x1", "6", "15", "1", "1000", "17", "0.05"] in [line.split() for line in lines]


def test_options_go_before_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("ACCORD_PORT", "1111")
    monkeypatch.setenv("ACCORD_HOME", str(tmp_path))
    assert load_settings().port == 1111
    settings = load_settings(home=Path("elsewhere"), port=2222)
    assert (settings.home, settings.port) == (Path("elsewhere"), 2222)


def test_the_url_is_the_running_services_own(tmp_path):
    settings = Settings(home=tmp_path)
    assert service_url(settings) == "http://127.0.0.1:8000"
    (tmp_path / "url").write_text("http://127.0.0.1:5555\n")
    assert service_url(settings) == "http://127.0.0.1:5555"
    assert service_url(settings.model_copy(update={"public_url": "https://a.example/"})) == "https://a.example"


def test_a_service_on_all_addresses_is_reached_on_this_machine():
    assert url_of("0.0.0.0", 80) == "http://127.0.0.1:80"
    assert url_of("127.0.0.1", 81) == "http://127.0.0.1:81"
