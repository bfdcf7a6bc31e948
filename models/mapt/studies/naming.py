"""Settings as they are written: KEY=VALUE; models and teachers: NAME, or NAME:setting=value:setting=value."""

import json
from dataclasses import dataclass

from mapt.studies.errors import InvalidStudy


@dataclass(frozen=True, slots=True)
class Written:
    """A name and the settings in which something differs from what usually has it."""

    name: str
    settings: dict[str, object]

    @classmethod
    def parse(cls, text: str) -> "Written":
        """Read a text such as `MAPT:tpa=false:hidden_dim=128`.

        Raises:
            InvalidStudy: if a part is no setting=value.
        """
        name, *parts = text.strip().split(":")
        settings: dict[str, object] = {}
        for part in parts:
            try:
                key, value = setting(part)
            except InvalidStudy as error:
                raise InvalidStudy(f"{error} in {text!r}; one looks like hidden_dim=128") from error
            settings[key] = value
        return cls(name, settings)


def setting(text: str) -> tuple[str, object]:
    """Key and value of KEY=VALUE: a number, true, false, null or a list as JSON writes them, or else a word.

    Raises:
        InvalidStudy: if it is none.
    """
    name, equals, value = text.strip().partition("=")
    if not name or not equals:
        raise InvalidStudy(f"{text!r} is no KEY=VALUE")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value
