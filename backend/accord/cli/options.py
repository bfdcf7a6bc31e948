"""Options that several commands share, and how they become settings."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from accord.domain.errors import Invalid
from accord.settings import Settings
from mapt.benchmarks.specification import numbers, setting, words
from mapt.errors import InvalidConfig
from mapt.preferences.teachers import PRESETS, teacher_names

Home = Annotated[
    Path | None,
    typer.Option(help="Folder of the database, the clips and the logs.  [default: ACCORD_HOME, or .accord]"),
]
Url = Annotated[str | None, typer.Option(help="Address of the service.  [default: the one that runs from --home]")]
Token = Annotated[
    str,
    typer.Option(
        envvar="ACCORD_TOKEN", help="Bearer token of a teacher; `accord user add NAME --role teacher` makes one."
    ),
]
TeacherName = Annotated[
    str,
    typer.Option(
        help=f"Which scripted teacher: {', '.join(teacher_names())}; or a rule with one of the first {len(PRESETS)}, "
        "such as phase+mistake."
    ),
]
Parameters = Annotated[
    list[str] | None,
    typer.Option(
        "--parameter", metavar="KEY=VALUE", help="A parameter of the teacher, such as mistake=0.1; as often as wanted."
    ),
]


def load_settings(home: Path | None = None, host: str | None = None, port: int | None = None) -> Settings:
    """Settings from the environment; what an option gave goes before it.

    Raises:
        pydantic.ValidationError: if an ACCORD_* variable makes no sense.
    """
    given = {"home": home, "host": host, "port": port}
    return Settings(**{name: value for name, value in given.items() if value is not None})  # pyright: ignore[reportArgumentType]


def address_file(settings: Settings) -> Path:
    """Where a running `accord up` writes its URL, for the other commands."""
    return settings.home / "url"


def service_url(settings: Settings) -> str:
    """The URL of the service that runs from this home, or would."""
    if settings.public_url:
        return settings.public_url.rstrip("/")
    path = address_file(settings)
    if path.exists():
        return path.read_text().strip()
    return url_of(settings.host, settings.port)


def url_of(host: str, port: int) -> str:
    """A URL that a browser on this machine can open."""
    name = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, host)
    return f"http://{name}:{port}"


def parse_numbers(option: str, text: str, least: int) -> tuple[int, ...]:
    """Raises Invalid, with an example."""
    try:
        return numbers(option, text, least)
    except InvalidConfig as error:
        raise Invalid(f"{error}.") from error


def parse_words(option: str, text: str) -> tuple[str, ...]:
    """Raises Invalid."""
    try:
        return words(option, text)
    except InvalidConfig as error:
        raise Invalid(f"{error}.") from error


def parse_settings(option: str, texts: Sequence[str], example: str) -> dict[str, Any]:
    """Settings written as KEY=VALUE.

    Raises:
        Invalid: if one is none; it shows the example.
    """
    try:
        return dict(setting(text) for text in texts)
    except InvalidConfig as error:
        raise Invalid(f"{option} {error}. One looks like {example}.") from error
