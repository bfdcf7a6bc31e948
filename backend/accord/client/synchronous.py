"""The client that blocks: each method runs that of `AsyncClient` over a blocking connection."""

from collections.abc import AsyncGenerator, Callable, Coroutine, Generator
from functools import wraps
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

from accord.client.asynchronous import AsyncClient
from accord.client.http import RETRY_SECONDS, BlockingConnection, finish

P = ParamSpec("P")
T = TypeVar("T")


def _blocking(
    method: Callable[Concatenate[AsyncClient, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate["Client", P], T]:
    """A method that returns what the coroutine returns."""

    @wraps(method)
    def call(client: "Client", /, *args: P.args, **kwargs: P.kwargs) -> T:
        return finish(method(client.asynchronous, *args, **kwargs))

    return call


def _blocking_generator(
    method: Callable[Concatenate[AsyncClient, P], AsyncGenerator[T]],
) -> Callable[Concatenate["Client", P], Generator[T]]:
    """A method that yields what the asynchronous generator yields."""

    @wraps(method)
    def call(client: "Client", /, *args: P.args, **kwargs: P.kwargs) -> Generator[T]:
        found = method(client.asynchronous, *args, **kwargs)
        try:
            while True:
                try:
                    yield finish(found.__anext__())  # type: ignore[arg-type]
                except StopAsyncIteration:
                    return
        finally:
            finish(found.aclose())

    return call


class Client:
    """A client of a running service. It is a context manager; see `AsyncClient` for the arguments and the errors."""

    def __init__(
        self, url: str, token: str, *, retry_seconds: float = RETRY_SECONDS, stopped: Callable[[], bool] = bool
    ) -> None:
        #: runs over a blocking connection
        self.asynchronous = AsyncClient(
            url, token, retry_seconds=retry_seconds, stopped=stopped, connect=BlockingConnection
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    close = _blocking(AsyncClient.close)
    get = _blocking(AsyncClient.get)
    get_bytes = _blocking(AsyncClient.get_bytes)
    post = _blocking(AsyncClient.post)
    create_experiment = _blocking(AsyncClient.create_experiment)
    experiment = _blocking(AsyncClient.experiment)
    experiments = _blocking(AsyncClient.experiments)
    pause = _blocking(AsyncClient.pause)
    resume = _blocking(AsyncClient.resume)
    cancel = _blocking(AsyncClient.cancel)
    metrics = _blocking(AsyncClient.metrics)
    reward_versions = _blocking(AsyncClient.reward_versions)
    events = _blocking_generator(AsyncClient.events)
    next_queries = _blocking(AsyncClient.next_queries)
    segment_arrays = _blocking(AsyncClient.segment_arrays)
    put_labels = _blocking(AsyncClient.put_labels)
    teach = _blocking(AsyncClient.teach)
    label_queries = _blocking(AsyncClient.label_queries)
    download_reward = _blocking(AsyncClient.download_reward)
    upload_policy = _blocking(AsyncClient.upload_policy)
    download_policy = _blocking(AsyncClient.download_policy)
    export = _blocking(AsyncClient.export)
    import_experiment = _blocking(AsyncClient.import_experiment)
