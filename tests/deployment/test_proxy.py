"""TLS by Caddy, with docs/deploy/Caddyfile, in front of two real servers."""

import os
import shutil
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import httpx
import pytest

from accord.services import accounts
from support.api_process import Server, running_server
from support.ports import free_port
from support.sample_experiments import CLIP_BYTES, create_sample
from support.stores import open_stores
from support.waiting import until

CADDYFILE = Path(__file__).parents[2] / "docs" / "deploy" / "Caddyfile"
pytestmark = [
    pytest.mark.deployment,
    pytest.mark.skipif(not shutil.which("caddy"), reason="caddy is not installed"),
]


@contextmanager
def caddy(folder: Path, https_port: int, servers: list[Server]) -> Iterator[httpx.Client]:
    """The proxy; yields a client that trusts its certificate authority."""
    environment = os.environ | {
        "ACCORD_HTTP_PORT": str(free_port()),
        "ACCORD_HTTPS_PORT": str(https_port),
        "ACCORD_UPSTREAMS": " ".join(server.url.removeprefix("http://") for server in servers),
        "XDG_DATA_HOME": str(folder),
        "XDG_CONFIG_HOME": str(folder),
        "HOME": str(folder),
    }
    command = ["caddy", "run", "--config", str(CADDYFILE)]
    with (
        (folder / "caddy.log").open("wb") as log,
        subprocess.Popen(command, env=environment, stdout=log, stderr=log) as process,
    ):
        try:
            root = folder / "caddy" / "pki" / "authorities" / "local" / "root.crt"
            until(root.exists, "Caddy has a certificate authority")
            context = ssl.create_default_context(cafile=str(root))
            with httpx.Client(
                base_url=f"https://localhost:{https_port}", verify=context, trust_env=False, timeout=30
            ) as client:

                def answers() -> bool:
                    with suppress(httpx.TransportError):
                        return client.get("/api/v1/ready").is_success
                    return False

                until(answers, "the proxy answers")
                yield client
        finally:
            process.terminate()


def test_the_proxy_encrypts_streams_and_goes_on_without_a_server_that_stopped(tmp_path: Path) -> None:
    https_port = free_port()
    with ExitStack() as opened:
        stores = opened.enter_context(open_stores(tmp_path))
        sample = create_sample(stores.database, stores.blobs)
        environment = {
            "ACCORD_PUBLIC_URL": f"https://localhost:{https_port}",
            "ACCORD_LOG_REQUESTS": "true",
            "ACCORD_DATABASE_URL": stores.database_url,
            "ACCORD_BLOB_URL": stores.blob_url,
        }
        servers = [opened.enter_context(running_server(tmp_path / name, environment)) for name in ("one", "two")]
        browser = opened.enter_context(caddy(tmp_path, https_port, servers))
        assert browser.get("/api/v1/experiments").status_code == 401
        browser.headers["Authorization"] = f"Bearer {sample.owner_token}"
        path = f"/api/v1/experiments/{sample.experiment.id}"
        # The servers learn from the proxy that the connection is encrypted.
        with stores.database.transaction() as session:
            link = accounts.make_link(session, sample.owner.id, 60)
        assert "secure" in browser.post(f"/api/v1/sign-in/{link}").headers["Set-Cookie"].lower()
        with browser.stream("GET", f"{path}/events") as stream:
            assert next(stream.iter_lines()).startswith(("event:", "id:"))
        [query] = browser.post(f"{path}/queries/next", json={}).json()["items"]
        assert browser.get(query["left"]["clip_url"]).content == CLIP_BYTES
        part = browser.get(query["left"]["clip_url"], headers={"Range": "bytes=0-9"})
        assert (part.status_code, part.content) == (206, CLIP_BYTES[:10])
        assert all("/experiments" in server.log.read_text() for server in servers)
        servers[0].stop()
        assert {browser.get(path).status_code for _ in range(6)} == {200}
        answers: list[int] = []

        def is_left_out() -> bool:
            answers.append(browser.put(f"/api/v1/queries/{query['id']}/label", json={"label": 1}).status_code)
            return len(answers) >= 6 and all(code in {200, 201} for code in answers[-6:])

        until(is_left_out, "labels no longer go to the stopped server")
        assert set(answers) <= {200, 201, 502}
        assert answers.count(201) == 1
