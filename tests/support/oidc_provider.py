"""A process that is an OpenID Connect provider."""

import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

from support.oidc_provider_process import CLIENT_ID, CLIENT_SECRET
from support.plain_http import PLAIN_HTTP
from support.waiting import PATIENCE_SECONDS

_PROGRAM = Path(__file__).with_name("oidc_provider_process.py")


@dataclass(frozen=True, slots=True)
class OidcProvider:
    """A running provider."""

    url: str

    def settings(self, **changes: object) -> dict[str, object]:
        """Settings of a server that uses it."""
        ours = {"oidc_issuer": self.url, "oidc_client_id": CLIENT_ID, "oidc_client_secret": CLIENT_SECRET}
        return ours | {"oidc_name": "the lab"} | changes

    def person(self, sub: str = "1", /, **changes: object) -> None:
        """Choose whom it identifies from now on.

        Args:
            changes: see `oidc_provider_process`; other names are claims.
        """
        faults = {name: changes.pop(name) for name in ("id_token", "key", "error", "userinfo") if name in changes}
        self.post("/person", {"claims": {"sub": sub} | changes} | faults)

    def post(self, path: str, content: object) -> None:
        httpx.post(f"{self.url}{path}", json=content, timeout=PATIENCE_SECONDS, **PLAIN_HTTP).raise_for_status()


@contextmanager
def running_oidc_provider() -> Generator[OidcProvider]:
    """Run a provider until the block ends."""
    process = subprocess.Popen([sys.executable, str(_PROGRAM)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert url, "the provider did not start"
        yield OidcProvider(url)
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()
