"""Models and teachers as they are written: NAME, or NAME:setting=value:setting=value."""

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
            key, equals, value = part.partition("=")
            if not key or not equals:
                raise InvalidStudy(f"{part!r} in {text!r} is no setting; it looks like hidden_dim=128")
            settings[key] = _value(value)
        return cls(name, settings)


def _value(text: str) -> object:
    """A number, true, false or null as JSON writes them; anything else is a word."""
    try:
        return json.loads(text)
    except ValueError:
        return text
