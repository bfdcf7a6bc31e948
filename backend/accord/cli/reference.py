"""python -m accord.cli.reference: writes the generated parts of docs/reference.md.

A part stands between `<!-- begin NAME -->` and `<!-- end NAME -->`; the rest of the page is written by hand.
"""

import argparse
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from accord.services.experiment_config import ExperimentConfig
from accord.settings import Settings as ServiceSettings
from mapt.policies.config import ALGORITHM_DEFAULTS, PolicyConfig
from mapt.settings import SettingDescription, Settings, accepted_values, describe

DEFAULT_FILE = Path("docs/reference.md")


def service_settings() -> str:
    """Environment variables of the service."""
    rows = [
        (
            f"`ACCORD_{name.upper()}`",
            _code(str(schema["default"]) if name != "home" else str(ServiceSettings.model_fields[name].default)),
            _NUMBER.sub("", accepted_values(schema)) if schema["type"] in ("integer", "number") else "",
            schema["description"],
        )
        for name, schema in ServiceSettings.model_json_schema()["properties"].items()
    ]
    return _table(("variable", "default", "values", ""), rows)


def experiment_settings() -> str:
    """Settings of an experiment."""
    return _settings(ExperimentConfig)


def policy_settings() -> str:
    """Settings of a policy, with the defaults of each algorithm."""
    own = {
        name: ", ".join(f"`{key}={value}`" for key, value in defaults.items())
        for name, defaults in ALGORITHM_DEFAULTS.items()
        if defaults
    }
    notes = "; ".join(f"`{name}`: {values}" for name, values in own.items())
    return f"{_settings(PolicyConfig)}\n\nDefaults that differ by algorithm: {notes}."


_NUMBER = re.compile("^a (whole )?number(,| from) ")

PARTS: Mapping[str, Callable[[], str]] = {
    "service settings": service_settings,
    "experiment settings": experiment_settings,
    "policy settings": policy_settings,
}


def fill(page: str) -> str:
    """The page with every generated part up to date.

    Raises:
        ValueError: if a part has no place in the page.
    """
    for name, part in PARTS.items():
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        if begin not in page or end not in page:
            raise ValueError(f"{begin} and {end} are missing from the page.")
        before, _, rest = page.partition(begin)
        page = f"{before}{begin}\n\n{part()}\n\n{end}{rest.partition(end)[2]}"
    return page


def main() -> None:
    """The entry point of `python -m accord.cli.reference`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, nargs="?", default=DEFAULT_FILE, help="the page (docs/reference.md)")
    file = parser.parse_args().file
    file.write_text(fill(file.read_text()))


def _settings(settings: type[Settings]) -> str:
    rows = [(f"`{row.name}`", _code(row.default), _values(row), row.description) for row in describe(settings)]
    return _table(("setting", "default", "values", ""), rows)


def _values(row: SettingDescription) -> str:
    """The choices or the range of a setting, as short as a table needs."""
    if row.range.startswith("one of "):
        return ", ".join(f"`{choice}`" for choice in row.range.removeprefix("one of ").split(", "))
    # a unit within the name is known already, as in `total_steps`
    unit = "" if not row.unit or row.unit in row.name else f" {row.unit}"
    return _NUMBER.sub("", row.range) + unit


def _code(text: str) -> str:
    return f"`{text}`" if text else ""


def _table(heading: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    heading = tuple(heading)
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join("| " + " | ".join(re.sub(r"\|", r"\\|", cell) for cell in line) + " |" for line in lines)


if __name__ == "__main__":
    main()
