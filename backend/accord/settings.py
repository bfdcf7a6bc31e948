"""Settings: environment variables with the prefix ACCORD_, read once and passed in."""

from pathlib import Path

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """Every setting of the service. `accord up` fills it; nothing reads it at import."""

    model_config = SettingsConfigDict(env_prefix="ACCORD_", extra="forbid", frozen=True)

    home: Path = Field(default=Path(".accord"), description="Folder of the database, the blobs and the logs.")
    database_url: str = Field(default="", description="SQLAlchemy URL; empty means SQLite in the home folder.")
    blob_url: str = Field(default="", description="fsspec URL of the blobs; empty means a folder in the home folder.")
    host: str = Field(default="127.0.0.1", description="Address the server listens on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port the server listens on; 0 means any free one.")
    public_url: str = Field(default="", description="URL of sign-in links when the server is behind a proxy.")
    lease_seconds: float = Field(
        default=60.0, gt=0, description="How long a query stays with a labeller who is silent."
    )
    max_body_bytes: int = Field(default=2_000_000, gt=0, description="Largest request body.")
    poll_seconds: float = Field(default=0.25, gt=0, description="Pause of a worker that found nothing to do.")
    worker_lease_seconds: float = Field(
        default=20.0,
        gt=0,
        description="After this long without a heartbeat a worker's claim is another's to take.",
    )
    render_workers: int = Field(default=1, ge=0, description="Render processes that `accord up` keeps running.")
    reward_workers: int = Field(default=1, ge=0, description="Reward processes that `accord up` keeps running.")
    policy_workers: int = Field(default=1, ge=0, description="Policy processes that `accord up` keeps running.")
    render_timeout_seconds: float = Field(default=60.0, gt=0, description="A clip that takes longer is given up.")
    torch_threads: int = Field(
        default=1,
        ge=1,
        description="Threads of torch in each of the reward and policy workers; more pay where cores stand idle.",
    )
    session_days: float = Field(default=30.0, gt=0, description="How long a browser stays signed in.")
    link_minutes: float = Field(default=60.0, gt=0, description="How long a one-time sign-in link works.")

    @property
    def resolved_database_url(self) -> str:
        return self.database_url or f"sqlite:///{(self.home / 'accord.db').resolve()}"

    @property
    def resolved_blob_url(self) -> str:
        return self.blob_url or f"file://{(self.home / 'blobs').resolve()}"
