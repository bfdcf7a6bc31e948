"""The exception tree of mapt: one root, drawn as it is, and every exception explained."""

import inspect
import pickle
from pathlib import Path

import pytest

from mapt import errors
from mapt.errors import InvalidConfig, MaptError, ModelMismatch, RunMismatch, UnknownTask

CLASSES = [each for each in vars(errors).values() if inspect.isclass(each) and each.__module__ == errors.__name__]


def drawn_tree() -> list[tuple[str, str]]:
    """(child, parent) of each line of the module's drawing."""
    edges: list[tuple[str, str]] = []
    ancestors: list[str] = []
    for line in (errors.__doc__ or "").splitlines():
        name = line.lstrip("│├└─ ")
        if not name.isidentifier():
            continue
        depth = (len(line) - len(name)) // 4
        ancestors[depth:] = [name]
        if depth:
            edges.append((name, ancestors[depth - 1]))
    return edges


def test_drawing_shows_every_exception_under_its_base():
    assert drawn_tree() == [(each.__name__, each.__bases__[0].__name__) for each in CLASSES if each is not MaptError]


@pytest.mark.parametrize("error", CLASSES)
def test_every_exception_derives_from_the_root_and_has_a_docstring(error):
    assert issubclass(error, MaptError)
    assert error.__doc__
    assert error.__doc__ not in {base.__doc__ for base in error.__mro__[1:]}


@pytest.mark.parametrize(
    "error",
    [
        InvalidConfig("gamma is 2; it must lie in [0, 1]", "gamma"),
        ModelMismatch("agents", 2, 3),
        RunMismatch(Path("runs/a"), ["seed is 0, not 1"]),
        UnknownTask("Halfcheetah", ("HalfCheetah-6x1",)),
    ],
)
def test_exceptions_survive_pickling_with_their_attributes(error):
    copy = pickle.loads(pickle.dumps(error))  # noqa: S301  (our own bytes)
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)
