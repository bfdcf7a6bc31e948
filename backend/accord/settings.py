"""Settings of the service: environment variables with the prefix ACCORD_."""

import os
from pathlib import Path
from socket import gethostname
from typing import Literal
from urllib.parse import urlsplit

from pydantic import Field, SecretStr, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SecretsSettingsSource, SettingsConfigDict

from accord.domain.addresses import is_loopback
from accord.domain.enums import Role


class Settings(BaseSettings):
    """Every setting of the service. A command reads them once and passes them on; no module reads them at import."""

    model_config = SettingsConfigDict(env_prefix="ACCORD_", extra="forbid", frozen=True)

    home: Path = Field(default=Path(".accord"), description="Folder of the database, the blobs and the logs.")
    database_url: str = Field(default="", description="SQLAlchemy URL; empty uses SQLite in the home folder.")
    blob_url: str = Field(
        default="",
        description="file:///folder or s3://bucket/prefix of the blobs; empty uses a folder in the home folder.",
    )
    host_name: str = Field(
        default="",
        pattern=r"^[A-Za-z0-9_.-]{0,30}$",
        description="With PostgreSQL: unique name of this host in the ids of its workers, as policy-0@gpu1; empty "
        "takes that of the system.",
    )
    host: str = Field(default="127.0.0.1", description="Address the server listens on.")
    port: int = Field(default=8000, ge=0, le=65_535, description="Port the server listens on; 0 takes a free one.")
    public_url: str = Field(default="", description="URL of sign-in links when the server is behind a proxy.")
    allowed_hosts: str = Field(
        default="",
        description="Comma-separated host names for which the server answers, besides localhost, ACCORD_HOST and that "
        "of the public URL; `*` allows all. Requests for others are refused with 421.",
    )
    allow_plain_http: bool = Field(
        default=False,
        description="Listen beyond this machine without a public URL, although nothing encrypts what is sent.",
    )
    trusted_proxies: str = Field(
        default="127.0.0.1",
        description="With a public URL: comma-separated addresses or networks of the proxies whose X-Forwarded-For and "
        "X-Forwarded-Proto are believed.",
    )
    max_connections: int = Field(
        default=2000,
        ge=1,
        le=10**6,
        description="Most open connections; fewer if the system allows fewer files (`ulimit -n`). Beyond that, those "
        "that wait for a request are closed.",
    )
    request_timeout_seconds: float = Field(
        default=20.0,
        gt=0,
        le=3600,
        description="How long a client may take to send the headers of a request, and its body before its token is "
        "verified.",
    )
    transfer_timeout_seconds: float = Field(
        default=30.0,
        gt=0,
        le=3600,
        description="How long a client may take to send 16 kB of a larger body, or to read 16 kB of a response.",
    )
    failed_sign_ins_per_minute: int = Field(
        default=20,
        ge=1,
        le=10**6,
        description="Wrong tokens, sign-in links and invitations that one address may try; more are refused with 429.",
    )
    oidc_issuer: str = Field(
        default="",
        max_length=500,
        description="URL of an OpenID Connect provider with which people sign in; empty for none. It must use https, "
        "except on this machine.",
    )
    oidc_client_id: str = Field(
        default="",
        validate_default=True,
        description="Id of the client that is registered there, with the redirect URI "
        "ACCORD_PUBLIC_URL/api/v1/oidc/callback.",
    )
    oidc_client_secret: SecretStr = Field(
        default=SecretStr(""), description="Its secret; empty for a client without one."
    )
    oidc_name: str = Field(default="your organisation", description="Name of the provider on the sign-in page.")
    oidc_scope: str = Field(default="openid profile email", description="Scopes that are requested.")
    oidc_role: Literal["labeller", "researcher", "admin", "teacher", ""] = Field(
        default="labeller",
        description="Role of people in no group of ACCORD_OIDC_ROLES: labeller, researcher or admin; empty refuses "
        "them.",
    )
    oidc_groups_claim: str = Field(default="groups", description="Claim with a person's groups at the provider.")
    oidc_roles: str = Field(
        default="",
        description="Comma-separated GROUP=ROLE. If set, each sign-in gives people the highest role of their groups.",
    )
    lease_seconds: float = Field(
        default=60.0,
        gt=0,
        le=86_400,
        description="How long a query is reserved for a labeller who sends neither a label nor a heartbeat.",
    )
    max_leases: int = Field(
        default=32,
        ge=1,
        le=10_000,
        description="Most queries that are reserved for one labeller at a time, in all tabs and experiments together.",
    )
    max_body_bytes: int = Field(default=2_000_000, ge=1000, le=10**9, description="Largest request body.")
    max_import_bytes: int = Field(
        default=4_000_000_000, ge=1000, le=10**13, description="Largest export that can be uploaded to the page."
    )
    max_training_bytes: int = Field(
        default=0,
        ge=0,
        le=10**15,
        description="Memory that the training of an experiment may need by its estimate; 0 for that of the machine. A "
        "larger one is refused when it is created.",
    )
    poll_seconds: float = Field(
        default=0.25, gt=0, le=60, description="How long a worker waits before it looks for work again."
    )
    worker_lease_seconds: float = Field(
        default=20.0,
        gt=0,
        le=3600,
        description="After this long without a heartbeat, a worker's claim expires.",
    )
    worker_hang_seconds: float = Field(
        default=600.0,
        gt=0,
        le=86_400,
        description="A worker whose main thread used no CPU time for this long hangs, and is restarted.",
    )
    api_timeout_seconds: float = Field(
        default=20.0,
        gt=0,
        le=3600,
        description="`accord up` restarts the server's process when two requests in a row get no response for this "
        "long each.",
    )
    render_workers: int = Field(default=1, ge=0, le=256, description="Render processes that `accord up` keeps running.")
    reward_workers: int = Field(default=1, ge=0, le=256, description="Reward processes that `accord up` keeps running.")
    policy_workers: int = Field(default=1, ge=0, le=256, description="Policy processes that `accord up` keeps running.")
    ray_resources: bool = Field(
        default=False,
        description="With --ray: place workers only on nodes with the custom resources policy, reward and render, one "
        "for each worker.",
    )
    ray_policy_gpus: float = Field(
        default=0.0, ge=0, le=64, description="With --ray: GPUs of each policy worker; may be a fraction."
    )
    ray_reward_gpus: float = Field(
        default=0.0, ge=0, le=64, description="With --ray: GPUs of each reward worker; may be a fraction."
    )
    ray_autoscale: bool = Field(
        default=False,
        description="With --ray: run only as many workers as have something to do, up to the numbers above and at "
        "least one of each role; Ray's autoscaler then adds and removes nodes.",
    )
    render_timeout_seconds: float = Field(
        default=60.0,
        gt=0,
        le=3600,
        description="Longest time to render one clip; after it the render process is replaced.",
    )
    clip_quality: Literal["fast", "smooth", "pretty"] = Field(
        default="smooth",
        description="smooth: clips with anti-aliasing. fast: without, in 0.6 of the time. pretty: with shadows, in "
        "twice the time.",
    )
    clip_width: int = Field(
        default=640,
        ge=128,
        le=1920,
        multiple_of=64,
        description="Width of clips in pixels, a multiple of 64; the height is three quarters of it. Time and size "
        "grow with the area.",
    )
    clip_redirects: bool = Field(
        default=False,
        description="With S3: redirect browsers to S3 for videos, by URLs that are valid for an hour. The bucket must "
        "allow the page's origin (CORS).",
    )
    torch_threads: int = Field(
        default=1,
        ge=1,
        le=1024,
        description="Threads of torch in each reward and policy worker; more than 1 helps only where cores are idle.",
    )
    reward_processes: int = Field(
        default=1,
        ge=1,
        le=20,
        description="Processes in which each reward worker trains the networks of a version whose attention is in use, "
        "the folds of a trial of attention, or the members of an ensemble, at the same time: up to 5 where cores are "
        "idle. Each needs about half a gigabyte of memory.",
    )
    webhook_private_addresses: bool = Field(
        default=False,
        description="Webhooks may lead to this machine and to private networks, and may use http instead of https.",
    )
    metrics_token: str = Field(
        default="",
        description="Bearer token that reads /metrics and nothing else, for Prometheus. Empty: only admins read them.",
    )
    log_format: Literal["text", "json"] = Field(
        default="text", description="text: logs are lines for people. json: every line is a JSON object."
    )
    log_requests: bool = Field(
        default=False,
        description="Log every request, not only those that fail with 500 or above, or take longer than a second.",
    )
    session_days: float = Field(default=30.0, gt=0, le=3650, description="How long a browser stays signed in.")
    link_minutes: float = Field(
        default=60.0, gt=0, le=525_600, description="How long a one-time sign-in link is valid."
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Arguments first, then variables, then the files in $CREDENTIALS_DIRECTORY, the folder of secrets of systemd.

        A file is named like a variable, in lower case, and its content is the value.
        """
        folder = os.environ.get("CREDENTIALS_DIRECTORY")
        return init_settings, env_settings, SecretsSettingsSource(settings_cls, folder)

    @field_validator("oidc_issuer")
    @classmethod
    def _check_issuer(cls, value: str) -> str:
        url = urlsplit(value)
        encrypted = url.scheme == "https" or (url.scheme == "http" and is_loopback(url.hostname or ""))
        if value and not (encrypted and url.hostname):
            raise ValueError("must be an https URL, or one of this machine")
        return value

    @field_validator("oidc_client_id")
    @classmethod
    def _check_client_id(cls, value: str, info: ValidationInfo) -> str:
        if info.data.get("oidc_issuer") and not value:
            raise ValueError("must be set, because ACCORD_OIDC_ISSUER is")
        return value

    @field_validator("oidc_roles")
    @classmethod
    def _check_roles(cls, value: str) -> str:
        _parsed_roles(value)
        return value

    @property
    def oidc_group_roles(self) -> dict[str, Role]:
        """Group at the provider -> role."""
        return _parsed_roles(self.oidc_roles)

    @property
    def resolved_database_url(self) -> str:
        """`database_url`, or SQLite in the home folder."""
        return self.database_url or f"sqlite:///{(self.home / 'accord.db').resolve()}"

    @property
    def shares_database(self) -> bool:
        """Whether other hosts can use the database."""
        return not self.resolved_database_url.startswith("sqlite")

    @property
    def worker_host(self) -> str:
        """The name of this host in the ids of its workers; empty where no other host can have any."""
        return self.host_name or gethostname()[-30:] if self.shares_database else ""

    def worker_id(self, name: str) -> str:
        """The id of a worker's row.

        Args:
            name: role and slot, for example policy-0.
        """
        return f"{name}@{self.worker_host}" if self.worker_host else name

    @property
    def resolved_blob_url(self) -> str:
        """`blob_url`, or a folder in the home folder."""
        return self.blob_url or f"file://{(self.home / 'blobs').resolve()}"


def _parsed_roles(text: str) -> dict[str, Role]:
    """Raises ValueError."""
    found: dict[str, Role] = {}
    for each in filter(None, (part.strip() for part in text.split(","))):
        group, separator, role = each.rpartition("=")
        if not separator or role not in set(Role):
            raise ValueError(f"{each!r} is not GROUP=ROLE with one of the roles {', '.join(Role)}")
        found[group.strip()] = Role(role)
    return found
