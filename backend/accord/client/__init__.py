"""The Python client of the REST API, which docs/client.md describes.

    from accord.client import Client

    with Client("http://127.0.0.1:8000", token) as accord:
        experiment = accord.create_experiment("first", "HalfCheetah-6x1", label_budget=200)
        accord.teach(experiment.id, lambda first, second: float(first.rewards.sum() > second.rewards.sum()))

`AsyncClient` has the same methods as coroutines.
"""

from accord.api.schemas import BatchLabel, Experiment, Metrics, Query, RewardVersion, Worker
from accord.client.asynchronous import AsyncClient, Event
from accord.client.http import Refused
from accord.client.synchronous import Client
from accord.client.teaching import Judge, Segment, TeachingOutcome
from accord.domain.errors import Unavailable

__all__ = [
    "AsyncClient",
    "BatchLabel",
    "Client",
    "Event",
    "Experiment",
    "Judge",
    "Metrics",
    "Query",
    "Refused",
    "RewardVersion",
    "Segment",
    "TeachingOutcome",
    "Unavailable",
    "Worker",
]
