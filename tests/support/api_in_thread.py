"""The application with a real HTTP server, in a thread of the test process."""

import threading
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import uvicorn

from accord.api.app import create_app
from accord.api.listener import address_of, listen
from accord.api.server import server_config
from accord.domain.enums import Role
from accord.settings import Settings
from accord.store.tables import UserRow
from support.plain_http import PLAIN_HTTP
from support.sample_experiments import user
from support.stores import Stores
from support.waiting import PATIENCE_SECONDS, until


@dataclass(frozen=True, slots=True)
class ApiServer:
    """A running server with one user of each role."""

    stores: Stores
    settings: Settings
    url: str
    #: bearer tokens by role
    tokens: dict[Role, str]
    #: sends no token
    anyone: httpx.Client
    labeller: httpx.Client
    teacher: httpx.Client
    researcher: httpx.Client
    admin: httpx.Client

    def client(self, token: str | None, **options: object) -> httpx.Client:
        """A new client, which the caller closes."""
        return client(self.url, token, **options)


def client(url: str, token: str | None, **options: object) -> httpx.Client:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    return httpx.Client(base_url=url, headers=headers, timeout=PATIENCE_SECONDS, **PLAIN_HTTP, **options)  # type: ignore[arg-type]


@contextmanager
def run_api_server(stores: Stores, home: Path, **changes: object) -> Generator[ApiServer]:
    """Run a server over the stores until the block ends. A second server over them has users of its own."""
    settings = Settings(home=home, **changes)  # type: ignore[arg-type]
    app = create_app(settings, stores.database, stores.blobs)
    config = server_config(app, settings)
    config.timeout_graceful_shutdown = 1
    server = uvicorn.Server(config)
    with stores.database.transaction() as session:
        number = session.query(UserRow).count()
        suffix = f" {number}" if number else ""
        tokens = {role: user(session, f"the {role}{suffix}", role)[1] for role in Role}
    listener = listen("127.0.0.1", 0)
    url = address_of(listener)
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    try:
        with ExitStack() as clients:
            until(lambda: server.started or not thread.is_alive(), "the server starts")
            assert thread.is_alive(), "the server did not start"
            by_role = {role: clients.enter_context(client(url, token)) for role, token in tokens.items()}
            yield ApiServer(
                stores=stores,
                settings=settings,
                url=url,
                tokens=tokens,
                anyone=clients.enter_context(client(url, None)),
                labeller=by_role[Role.LABELLER],
                teacher=by_role[Role.TEACHER],
                researcher=by_role[Role.RESEARCHER],
                admin=by_role[Role.ADMIN],
            )
    finally:
        # uvicorn takes 0.2 s to end after its last connection is closed; nothing waits for that.
        server.should_exit = True
        until(lambda: not server.server_state.connections or not thread.is_alive(), "all connections are closed")
