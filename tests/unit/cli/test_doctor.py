import socket
import sqlite3
from contextlib import closing
from pathlib import Path

from accord.cli import doctor
from accord.cli.doctor import (
    check_blobs,
    check_database,
    check_football,
    check_machine,
    check_packages,
    check_port,
    check_python,
)
from accord.domain.checks import Check
from accord.settings import Settings
from accord.store.database import Database
from accord.store.migrate import migrate


def test_installed_versions_pass_on_this_machine(tmp_path: Path):
    checks = [*check_python(Settings(home=tmp_path)), *check_packages(Settings(home=tmp_path))]
    assert [check.name for check in checks] == ["Python", "torch", "mujoco", "numpy"]
    assert all(check.ok and check.fix is None for check in checks)


def test_an_unsupported_python_fails_with_a_fix(monkeypatch, tmp_path: Path):
    monkeypatch.setattr(doctor, "_PYTHONS", ((3, 98), (3, 99)))
    [check] = check_python(Settings(home=tmp_path))
    assert not check.ok
    assert check.fix is not None
    assert "3.99" in check.fix


def test_a_missing_package_fails_with_a_fix(monkeypatch):
    check = doctor._check_package("no-such-package")
    assert check == Check("no-such-package", False, "not installed", "pip install --force-reinstall accord")


def test_a_missing_football_engine_passes_and_says_how_to_get_it(monkeypatch, tmp_path: Path):
    for installed, detail in ((True, "installed"), (False, "make football")):
        monkeypatch.setattr(doctor.football, "is_installed", lambda installed=installed: installed)
        [check] = check_football(Settings(home=tmp_path))
        assert check.ok
        assert detail in check.detail


def test_too_little_disk_space_fails_and_names_the_folder(monkeypatch, tmp_path: Path):
    monkeypatch.setattr(doctor, "_FREE_BYTES", 10**18)
    disk, memory = check_machine(Settings(home=tmp_path / "not" / "yet"))
    assert not disk.ok
    assert str(tmp_path) in disk.detail
    assert disk.fix is not None
    assert memory.ok


def test_a_missing_home_folder_passes_and_is_not_created(tmp_path: Path):
    settings = Settings(home=tmp_path / "home")
    assert all(check.ok for check in [*check_database(settings), *check_blobs(settings)])
    assert not (tmp_path / "home").exists()


def test_a_database_of_a_newer_version_fails(tmp_path: Path):
    settings = Settings(home=tmp_path)
    database = Database.open(settings.resolved_database_url)
    migrate(database)
    database.close()
    assert check_database(settings)[0].ok
    with closing(sqlite3.connect(tmp_path / "accord.db")) as connection, connection:
        connection.execute("UPDATE alembic_version SET version_num = 'from_the_future'")
    [check] = check_database(settings)
    assert not check.ok
    assert "from_the_future" in check.detail


def test_an_older_database_passes_and_is_not_migrated(tmp_path: Path):
    settings = Settings(home=tmp_path)
    file = tmp_path / "accord.db"
    with closing(sqlite3.connect(file)) as connection, connection:
        connection.execute("CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL)")
    [check] = check_database(settings)
    assert check.ok
    with closing(sqlite3.connect(file)) as connection:
        assert connection.execute("SELECT name FROM sqlite_master").fetchall() == [("alembic_version",)]


def test_a_missing_database_is_not_created(tmp_path: Path):
    file = tmp_path / "folder" / "accord.db"
    [check] = check_database(Settings(home=tmp_path, database_url=f"sqlite:///{file}"))
    assert check.ok
    assert not file.parent.exists()


def test_a_file_in_place_of_the_blob_folder_fails(tmp_path: Path):
    (tmp_path / "blobs").write_text("no folder")
    [check] = check_blobs(Settings(home=tmp_path))
    assert not check.ok


def test_a_port_in_use_fails_and_suggests_another(tmp_path: Path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        [check] = check_port(Settings(home=tmp_path, port=port))
    assert not check.ok
    assert check.fix is not None
    assert f"--port {port + 1}" in check.fix
    assert check_port(Settings(home=tmp_path, port=port))[0].ok
