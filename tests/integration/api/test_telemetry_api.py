"""Traces of requests, sent to a real receiver of OpenTelemetry."""

import threading
from collections.abc import Generator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from support.api_process import running_server
from support.plain_http import PLAIN_HTTP


@pytest.fixture
def collector() -> Generator[tuple[str, list[ExportTraceServiceRequest]]]:
    """The URL of a receiver, and the traces that it received."""
    received: list[ExportTraceServiceRequest] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            content = self.rfile.read(int(self.headers["Content-Length"]))
            if self.path == "/v1/traces":
                received.append(ExportTraceServiceRequest.FromString(content))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", received
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.slow
def test_requests_are_traced_without_the_tokens_of_links(
    tmp_path: Path, collector: tuple[str, list[ExportTraceServiceRequest]]
) -> None:
    url, received = collector
    environment = {
        "OTEL_EXPORTER_OTLP_ENDPOINT": url,
        "OTEL_EXPORTER_OTLP_COMPRESSION": "none",
        "OTEL_METRICS_EXPORTER": "none",
        "OTEL_LOGS_EXPORTER": "none",
        "OTEL_SERVICE_NAME": "accord-of-the-lab",
    }
    with running_server(tmp_path, environment) as server:
        with httpx.Client(base_url=server.url, **PLAIN_HTTP) as client:
            client.get("/api/v1/me", headers={"Authorization": "Bearer wrong"})
            client.post("/api/v1/sign-in/a-secret")
            client.get("/sign-in/a-secret")
        assert server.stop() == 0
    spans = [
        (span.name, {each.key: each.value for each in span.attributes})
        for request in received
        for resource in request.resource_spans
        for scope in resource.scope_spans
        for span in scope.spans
    ]
    [me] = [attributes for name, attributes in spans if name == "GET /api/v1/me"]
    assert me["http.response.status_code"].int_value == 401
    assert "a-secret" not in str(received)
    assert "accord-of-the-lab" in str(received)
