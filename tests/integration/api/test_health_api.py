"""Health checks: the server's process answers, and the service can work."""

from pathlib import Path

from sqlalchemy import text

from support.api_in_thread import ApiServer


def assert_not_ready(api: ApiServer, *secrets: str) -> None:
    response = api.anyone.get("/api/v1/ready")
    assert (response.status_code, response.json()["error"]["code"]) == (503, "unavailable")
    assert response.headers["Retry-After"]
    assert not any(secret in response.text for secret in secrets)
    # Restarting the server would not help.
    assert api.anyone.get("/api/v1/health").status_code == 200


def test_a_service_with_migrated_database_and_writable_blobs_is_ready(api_per_database: ApiServer) -> None:
    assert api_per_database.anyone.get("/api/v1/ready").json() == {"status": "ok"}


def test_a_service_whose_database_is_not_migrated_is_not_ready(api_per_database: ApiServer) -> None:
    with api_per_database.stores.database.transaction() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '0001'"))
    assert_not_ready(api_per_database, "0001", "sql")


def test_a_service_whose_database_is_damaged_is_not_ready(api: ApiServer) -> None:
    path = Path(api.stores.database_url.removeprefix("sqlite:///"))
    api.stores.database.close()
    for file in (path, Path(f"{path}-wal"), Path(f"{path}-shm")):
        file.unlink(missing_ok=True)
    path.write_bytes(b"not a database" * 1000)
    assert_not_ready(api, str(path))


def test_a_service_whose_blobs_cannot_be_written_is_not_ready(api: ApiServer) -> None:
    folder = Path(api.stores.blob_url.removeprefix("file://"))
    folder.rename(folder.with_name("elsewhere"))
    folder.write_text("a file where the folder should be")
    assert_not_ready(api, str(folder))
