"""Metrics in the format of Prometheus: of this process, and of the rows that workers and other servers write.

What the rows hold is read when Prometheus asks, so that it is the same in every server process and costs requests
nothing. Times are exported instead of ages, as Prometheus recommends: `time() - accord_..._timestamp_seconds`.
"""

import shutil
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

from anyio import CapacityLimiter
from prometheus_client import CollectorRegistry, Gauge, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from accord.domain.enums import DeliveryStatus, ExperimentStatus, WorkerState
from accord.domain.errors import DatabaseUnreachable
from accord.services import monitoring
from accord.services.monitoring import Monitored
from accord.settings import Settings
from accord.store.database import Database

#: upper limits of the histogram's buckets: labels take milliseconds, exports and imports seconds
_BUCKETS_SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
_EXPERIMENT = ("experiment", "experiment_id")


class Monitoring:
    """The metrics of one application."""

    def __init__(self, settings: Settings, database: Database) -> None:
        #: threads of their own, so that metrics can be read when those of other requests are all blocked
        self.threads = CapacityLimiter(2)
        self._registry = CollectorRegistry()
        self._requests = Histogram(
            "accord_http_request_duration_seconds",
            "Time from a request to the beginning of its response.",
            ("method", "route", "status"),
            buckets=_BUCKETS_SECONDS,
            registry=self._registry,
        )
        self._streams = Gauge("accord_event_streams", "Open event streams.", registry=self._registry)
        self._threads = Gauge(
            "accord_server_threads_busy",
            "Threads that work on requests or wait for the database.",
            registry=self._registry,
        )
        self._max_threads = Gauge(
            "accord_server_threads_max", "Threads that the server has at most.", registry=self._registry
        )
        ProcessCollector(registry=self._registry)
        self._registry.register(_Rows(database))
        self._registry.register(_Disk(settings))

    def observe_request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request. `route` has the names of path parameters, so that there are few."""
        self._requests.labels(method if method in _METHODS else "other", route, status).observe(seconds)

    def text(self, streams: int, busy_threads: int, max_threads: float) -> bytes:
        """Every metric in Prometheus's text format. Blocks on the database."""
        self._streams.set(streams)
        self._threads.set(busy_threads)
        self._max_threads.set(max_threads)
        return generate_latest(self._registry)


class _Rows(Collector):
    """Metrics of rows, read anew each time."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def describe(self) -> Iterable[Metric]:
        """Nothing: without this method, the registry would read the rows to learn the names."""
        return ()

    def collect(self) -> Iterator[Metric]:
        found = None
        # Prometheus would take a failed response for a server that is down.
        with suppress(DatabaseUnreachable), self._database.reading() as session:
            found = monitoring.read(session)
        reachable = GaugeMetricFamily("accord_database_up", "1 if the database can be read.")
        reachable.add_metric((), found is not None)
        yield reachable
        if found is not None:
            yield from _experiments(found)
            yield from _workers(found)
            yield _deliveries(found)


def _experiments(found: Monitored) -> Iterator[Metric]:
    statuses = GaugeMetricFamily("accord_experiments", "Experiments by status.", labels=("status",))
    for status in ExperimentStatus:
        statuses.add_metric((status.value,), found.statuses.get(status.value, 0))
    yield statuses

    def gauge(name: str, text: str) -> GaugeMetricFamily:
        return GaugeMetricFamily(f"accord_{name}", f"{text} Of each running or paused experiment.", labels=_EXPERIMENT)

    changes = CounterMetricFamily(
        "accord_label_changes",
        "Labels and skips that were acknowledged, changed or undone. Of each running or paused experiment.",
        labels=_EXPERIMENT,
    )
    labels = gauge("labels", "Labels that count towards the budget.")
    budget = gauge("label_budget", "Labels that the experiment asks for at most.")
    due = gauge("labels_due", "Labels that the schedule asks for by now.")
    open_queries = gauge("open_queries", "Queries that are ready to label.")
    rendering = gauge("rendering_queries", "Queries whose clips are not rendered yet.")
    clips = gauge("clip_queue", "Clips and other videos that are not rendered yet.")
    steps = gauge("policy_steps", "Environment steps that the policy has taken.")
    version = gauge("reward_version", "Number of the newest reward version; 0 before the first.")
    version_at = gauge("reward_version_timestamp_seconds", "When the newest reward version was published.")
    phase = GaugeMetricFamily(
        "accord_experiment_phase",
        "1 for the status and the phase of each running or paused experiment.",
        labels=(*_EXPERIMENT, "status", "phase"),
    )
    for each in found.experiments:
        row, counts = each.row, each.counts
        named = (row.name, row.id)
        changes.add_metric(named, row.label_revision)
        for metric, value in (
            (labels, counts.labels),
            (budget, counts.budget),
            (due, counts.due),
            (open_queries, counts.open_queries),
            (rendering, counts.rendering_queries),
            (clips, each.clip_queue),
            (steps, row.steps),
            (version, each.version_number),
        ):
            metric.add_metric(named, value)
        if each.version_at is not None:
            version_at.add_metric(named, each.version_at.timestamp())
        phase.add_metric((*named, row.status, row.phase), 1)
    yield from (changes, labels, budget, due, open_queries, rendering, clips, steps, version, version_at, phase)


def _workers(found: Monitored) -> Iterator[Metric]:
    names = ("worker_id", "role")
    state = GaugeMetricFamily("accord_worker_state", "1 for the state of each worker.", labels=(*names, "state"))
    heartbeat = GaugeMetricFamily(
        "accord_worker_heartbeat_timestamp_seconds", "Last heartbeat of each worker that was not stopped.", labels=names
    )
    restarts = CounterMetricFamily("accord_worker_restarts", "Restarts since `accord up` was started.", labels=names)
    for row in found.workers:
        state.add_metric((row.id, row.role, row.state), 1)
        restarts.add_metric((row.id, row.role), row.restarts)
        if row.state != WorkerState.STOPPED:
            heartbeat.add_metric((row.id, row.role), row.heartbeat_at.timestamp())
    yield from (state, heartbeat, restarts)


def _deliveries(found: Monitored) -> Metric:
    text = "Deliveries of webhooks that are pending, and those of the last 30 days."
    deliveries = GaugeMetricFamily("accord_webhook_deliveries", text, labels=("status",))
    for status in DeliveryStatus:
        deliveries.add_metric((status.value,), found.deliveries.get(status.value, 0))
    return deliveries


class _Disk(Collector):
    """Free space where the database, the logs and the blobs are, as far as these are folders of this machine."""

    def __init__(self, settings: Settings) -> None:
        self._folders = {"home": settings.home}
        blobs = urlsplit(settings.resolved_blob_url)
        if blobs.scheme == "file":
            self._folders["blobs"] = Path(blobs.path)

    def describe(self) -> Iterable[Metric]:
        """Nothing, as for the rows."""
        return ()

    def collect(self) -> Iterator[Metric]:
        free = GaugeMetricFamily("accord_disk_free_bytes", "Free space on the disk of each folder.", labels=("folder",))
        size = GaugeMetricFamily("accord_disk_size_bytes", "Size of the disk of each folder.", labels=("folder",))
        for name, folder in self._folders.items():
            with suppress(FileNotFoundError):
                usage = shutil.disk_usage(folder)
                free.add_metric((name,), usage.free)
                size.add_metric((name,), usage.total)
        yield from (free, size)
