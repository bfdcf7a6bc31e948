"""Creates the FastAPI application."""

from importlib.metadata import version
from typing import Any

from fastapi import FastAPI
from fastapi.routing import APIRoute
from starlette.types import ASGIApp, Scope

from accord.api import errors
from accord.api.body_limit import BodyLimit
from accord.api.dependencies import AppState
from accord.api.monitoring import Monitoring
from accord.api.oidc import Provider
from accord.api.pages import Page
from accord.api.requests import Requests
from accord.api.routes import (
    accounts,
    audit,
    clips,
    credit,
    documentation,
    events,
    experiments,
    exports,
    health,
    imports,
    label_history,
    labelling,
    monitoring,
    oidc,
    people,
    quality,
    recordings,
    segments,
    shares,
    tokens,
    webhooks,
)
from accord.api.security import Security
from accord.api.sign_in_limit import SignInLimit
from accord.settings import Settings
from accord.store.blobs import BlobStore
from accord.store.database import Database

PREFIX = "/api/v1"
#: need no sign-in
_PUBLIC = (
    "/health",
    "/ready",
    "/join/{token}",
    "/sign-in/{token}",
    "/oidc",
    "/oidc/start",
    "/oidc/callback",
    "/oidc/sign-out",
)
_DESCRIPTION = """Preference-based reward learning for cooperative multi-agent reinforcement learning.

Sign in with `Authorization: Bearer <token>`. Every error has the same body: a stable `code`, a `message`, and
`details` that name an invalid `field`."""


def create_app(settings: Settings, database: Database, blobs: BlobStore) -> FastAPI:
    """The application over a migrated database. The caller opens and closes both stores."""
    app = _App(
        title="Accord",
        version=version("accord"),
        description=_DESCRIPTION,
        # `documentation` serves them to those who are signed in.
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        generate_unique_id_function=_operation_id,
        # Exports nothing unless OTEL_EXPORTER_OTLP_ENDPOINT is set, and needs the extra `otel`.
        telemetry={"auto_configure": True, "exclude": _has_token},
        responses=errors.RESPONSES,
    )
    app.state.accord = AppState(
        settings,
        database,
        blobs,
        SignInLimit(settings.failed_sign_ins_per_minute),
        Provider(settings) if settings.oidc_issuer else None,
    )
    app.state.streams = events.Streams()
    app.state.monitoring = Monitoring(settings, database)
    app.state.readiness = health.Readiness(database, blobs)
    # Routes are matched in this order, so the busiest come first.
    for module in (
        labelling,
        clips,
        label_history,
        segments,
        experiments,
        quality,
        credit,
        recordings,
        exports,
        imports,
        shares,
        events,
        accounts,
        oidc,
        tokens,
        people,
        audit,
        webhooks,
        health,
    ):
        app.include_router(module.router, prefix=PREFIX)
    app.include_router(documentation.router)
    app.include_router(monitoring.router)
    app.router.default = Page()
    errors.install(app)
    app.add_middleware(
        BodyLimit,
        limit_bytes=settings.max_body_bytes,
        larger={
            f"{PREFIX}{imports.PATH}": settings.max_import_bytes,
            f"{PREFIX}{imports.POLICIES_PATH}": min(imports.MAX_POLICY_BYTES, settings.max_import_bytes),
        },
        transfer_seconds=settings.transfer_timeout_seconds,
        authenticated=f"{PREFIX}/",
        public=(f"{PREFIX}/join/", f"{PREFIX}/sign-in/"),
    )
    return app


def _has_token(scope: Scope) -> bool:
    """Whether the address of a request contains the token of a link or the code of a provider; traces contain it."""
    path: str = scope.get("path", "")
    return "/sign-in/" in path or "/join/" in path or "/oidc/" in path


def _operation_id(route: APIRoute) -> str:
    """The function's name, so that the generated client does not change with a path."""
    return route.name


class _App(FastAPI):
    def build_middleware_stack(self) -> ASGIApp:
        """Outside of everything else, also of the response to an unexpected error."""
        settings: Settings = self.state.accord.settings
        metrics: Monitoring = self.state.monitoring
        blobs: BlobStore = self.state.accord.blobs
        clips_url = blobs.signed_url("clips", 1.0) if settings.clip_redirects else None
        secured = Security(super().build_middleware_stack(), settings, clips_url)
        return Requests(secured, metrics.observe_request, log_all=settings.log_requests)

    def openapi(self) -> dict[str, Any]:
        """The OpenAPI document with both authentication methods, created when it is first requested."""
        created = self.openapi_schema is None
        document = super().openapi()
        if created:
            components: dict[str, Any] = document.setdefault("components", {})
            components["securitySchemes"] = {
                "bearer": {"type": "http", "scheme": "bearer"},
                "cookie": {"type": "apiKey", "in": "cookie", "name": "accord_session"},
            }
            document["security"] = [{"bearer": []}, {"cookie": []}]
            for path in _PUBLIC:
                for operation in document["paths"][f"{PREFIX}{path}"].values():
                    operation["security"] = []
        return document
