"""What can be wrong with preferences.

PreferenceError
├── ShapeError
├── NotFinite
├── InvalidMask
├── InvalidLabel
├── InvalidPair
├── NotEnoughPairs
├── NotOneHot
├── InvalidAction
└── FileError                 of a file or folder, which is left as it was
    ├── AlreadyThere
    ├── NotReadable
    │   ├── Truncated
    │   ├── MissingPart
    │   ├── SchemaTooNew
    │   ├── TooLarge
    │   ├── UnsafePickle
    │   └── UnknownLabel
    └── NotExpressible
"""

from pathlib import Path


class PreferenceError(ValueError):
    """Segments, pairs or labels cannot be used as given."""


class ShapeError(PreferenceError):
    """An array has another shape than its place asks for."""

    def __init__(self, name: str, shape: tuple[int, ...], expected: str) -> None:
        super().__init__(f"{name} has shape {shape}, expected {expected}")


class NotFinite(PreferenceError):
    """An array holds NaN or infinity where the step is real."""

    def __init__(self, name: str, segment: int) -> None:
        super().__init__(f"{name} of segment {segment} holds NaN or infinity")


class InvalidMask(PreferenceError):
    """A segment's real steps are not one unbroken run from its first step."""

    def __init__(self, segment: int) -> None:
        super().__init__(f"segment {segment} must have its real steps first, at least one, then padding")


class InvalidLabel(PreferenceError):
    """A label is no probability that segment 0 is preferred."""

    def __init__(self, index: int, label: float) -> None:
        super().__init__(f"label {index} is {label}; it must lie in [0, 1] (1: segment 0 is better)")


class InvalidPair(PreferenceError):
    """A pair names a segment that is not there, or the same one twice."""

    def __init__(self, index: int, pair: tuple[int, int], n_segments: int) -> None:
        super().__init__(f"pair {index} is {pair}; it must name two different segments of {n_segments}")


class NotEnoughPairs(PreferenceError):
    """Fewer pairs than the task needs."""

    def __init__(self, n_pairs: int, needed: int) -> None:
        super().__init__(f"{n_pairs} labelled pairs, at least {needed} are needed")


class NotOneHot(PreferenceError):
    """A discrete action is not a single 1 among zeros."""

    def __init__(self, segment: int) -> None:
        super().__init__(f"actions of segment {segment} are not one-hot, as discrete actions are")


class InvalidAction(PreferenceError):
    """A discrete action is none of those there are, or was not available when it was chosen."""


class FileError(PreferenceError):
    """A file or folder cannot be read or written; nothing on disk was changed."""

    def __init__(self, path: Path | str, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = path


class AlreadyThere(FileError):
    """Writing would replace what somebody keeps."""

    def __init__(self, path: Path | str) -> None:
        super().__init__(path, "is there already; choose another name or remove it first")


class NotReadable(FileError):
    """A file is not what its format says."""


class Truncated(NotReadable):
    """A file ends before what it should hold."""

    def __init__(self, path: Path | str, problem: str = "ends before its content does") -> None:
        super().__init__(path, f"{problem}; was it copied whole?")


class MissingPart(NotReadable):
    """A column, an array, a key or a file of the format is not there."""

    def __init__(self, path: Path | str, part: str) -> None:
        super().__init__(path, f"has no {part}")


class SchemaTooNew(NotReadable):
    """A newer version of this program wrote the file."""

    def __init__(self, path: Path | str, found: object, known: int) -> None:
        super().__init__(path, f"has schema version {found}; this mapt reads up to {known}. Install a newer one")


class TooLarge(NotReadable):
    """A file declares more than its importer is willing to hold."""

    def __init__(self, path: Path | str, what: str, limit: int) -> None:
        super().__init__(path, f"declares {what}, more than the limit of {limit}; raise the limit if you trust it")


class UnsafePickle(NotReadable):
    """A pickle asks for more than arrays and containers, as one does that runs a program."""

    def __init__(self, path: Path | str, name: str) -> None:
        super().__init__(path, f"asks for {name}, which no data needs; it was not loaded, do not trust it")


class UnknownLabel(NotReadable):
    """A label is none of those that its format has."""

    def __init__(self, path: Path | str, index: int, label: object, known: str) -> None:
        super().__init__(path, f"label {index} is {label!r}; this format has {known}")


class NotExpressible(FileError):
    """A format has no place for something that the data holds."""
