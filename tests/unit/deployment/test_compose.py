"""docker-compose.yml, backend/Dockerfile, and the secrets of a lab. tests/deployment runs the Dockerfile's steps."""

import re
import stat
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from accord.settings import Settings

REPOSITORY = Path(__file__).parents[3]
DEPLOY = REPOSITORY / "docs" / "deploy"
COMPOSE: dict[str, Any] = yaml.safe_load((REPOSITORY / "docker-compose.yml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
#: what the proxy reads, and a command of Docker Compose
NOT_SETTINGS = {"ACCORD_DOMAIN", "ACCORD_UPSTREAMS", "ACCORD_HTTP_PORT", "ACCORD_HTTPS_PORT"}
OWN_IMAGE = {name for name, service in SERVICES.items() if service["image"] == "accord"}


def profile(name: str) -> set[str]:
    return {service for service, content in SERVICES.items() if name in content["profiles"]}


def make_secrets(folder: Path) -> dict[str, str]:
    subprocess.run([DEPLOY / "make-secrets", folder], check=True)
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_a_laptop_has_one_container_and_a_lab_its_parts() -> None:
    assert profile("laptop") == {"accord"}
    parts = {"api", "proxy", "postgres", "storage", "bucket"}
    assert profile("lab") == parts | {"workers"}
    assert profile("lab-gpu") == parts | {"workers-gpu"}
    assert SERVICES["api"]["deploy"]["replicas"] > 1


@pytest.mark.parametrize(
    "file",
    ["docker-compose.yml", "backend/Dockerfile", *(f"docs/deploy/{each.name}" for each in DEPLOY.glob("*.service"))],
)
def test_every_variable_is_a_setting(file: str) -> None:
    named = set(re.findall(r"ACCORD_[A-Z_]+", (REPOSITORY / file).read_text()))
    assert named
    assert named - NOT_SETTINGS <= {f"ACCORD_{name.upper()}" for name in Settings.model_fields}


@pytest.mark.parametrize("name", SERVICES)
def test_every_service_restarts_and_has_a_health_check(name: str) -> None:
    service = SERVICES[name]
    if name == "bucket":  # it ends, and others wait for its success
        assert "bucket" in SERVICES["api"]["depends_on"]
        return
    assert service["restart"] == "unless-stopped"
    if name.startswith("workers"):  # they have no server, and start once one is healthy
        assert service["depends_on"] == {"api": {"condition": "service_healthy"}}
        return
    assert name in OWN_IMAGE or service["healthcheck"]["test"]
    assert "HEALTHCHECK" in (REPOSITORY / "backend" / "Dockerfile").read_text()


def test_only_the_proxy_listens_beyond_the_machine() -> None:
    published = {name: service["ports"] for name, service in SERVICES.items() if "ports" in service}
    assert published.keys() == {"accord", "proxy"}
    assert all(port.startswith("127.0.0.1:") for port in published["accord"])


@pytest.mark.parametrize("name", SERVICES)
def test_secrets_come_from_files(name: str) -> None:
    environment: dict[str, str] = SERVICES[name].get("environment", {})
    secret = {
        key: value
        for key, value in environment.items()
        if re.search("PASSWORD|SECRET|TOKEN|USER_|KEY|CREDENTIALS", key)
    }
    assert all(value.startswith("/run/secrets") for value in secret.values())
    assert "ACCORD_DATABASE_URL" not in environment
    assert set(SERVICES[name].get("secrets", [])) <= set(COMPOSE["secrets"])


def test_files_that_are_mounted_or_copied_exist() -> None:
    mounts = [mount for service in SERVICES.values() for mount in service.get("volumes", [])]
    assert all((REPOSITORY / mount.split(":")[0]).is_file() for mount in mounts if mount.startswith("."))
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", (REPOSITORY / "backend" / "Dockerfile").read_text(), re.MULTILINE)
    assert all((REPOSITORY / source).exists() for line in copied for source in line.split())


def test_new_secrets_are_random_private_and_kept(tmp_path: Path) -> None:
    first, second = make_secrets(tmp_path / "first"), make_secrets(tmp_path / "second")
    files = {each["file"] for each in COMPOSE["secrets"].values()} | {COMPOSE["x-lab"]["env_file"][0]["path"]}
    assert first.keys() == second.keys() == {Path(file).name for file in files}
    assert all(first[name] != second[name] for name in first)
    assert make_secrets(tmp_path / "first") == first
    assert stat.S_IMODE((tmp_path / "first").stat().st_mode) == 0o700
    assert first["postgres_password"] in first["accord_database_url"]
    assert first["storage_password"] in first["storage.env"]
    assert min(len(first[name]) for name in ("postgres_password", "storage_password", "accord_metrics_token")) >= 40


def test_settings_are_read_from_files_unless_variables_replace_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    secrets = make_secrets(tmp_path)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    assert Settings().database_url == secrets["accord_database_url"]
    assert Settings().metrics_token == secrets["accord_metrics_token"]
    monkeypatch.setenv("ACCORD_METRICS_TOKEN", "another")
    assert Settings().metrics_token == "another"
    assert Settings(metrics_token="a third").metrics_token == "a third"
