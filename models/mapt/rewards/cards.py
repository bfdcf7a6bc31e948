"""What a stored reward model, or an ensemble of them, says of itself: its card."""

from collections.abc import Mapping
from pathlib import Path

from mapt.rewards.config import RewardConfig
from mapt.rewards.errors import DamagedCheckpoint, InvalidConfig, NewerCheckpoint

POLARITY = "label is P(segment 0 preferred): 1 segment 0, 0 segment 1, 0.5 equal; P = sigmoid(score_0 - score_1)"


def read_stored(source: bytes | Path) -> bytes:
    """The bytes of a blob, or of the file at a path.

    Raises:
        DamagedCheckpoint: if there is no such file.
    """
    if isinstance(source, bytes):
        return source
    try:
        return source.read_bytes()
    except FileNotFoundError as error:
        raise DamagedCheckpoint(f"{source.name} is missing") from error


def checked_card(card: object, format_name: str, known_version: int) -> Mapping[str, object]:
    """A card read from JSON, if it names this format in a version that is known.

    Raises:
        NewerCheckpoint: if a later version of this library wrote it.
        DamagedCheckpoint: if it is no such card.
    """
    if not isinstance(card, dict) or card.get("format") != format_name:
        raise DamagedCheckpoint(f"its card does not name the format {format_name}")
    version = card.get("format_version")
    if not isinstance(version, int) or version < 1:
        raise DamagedCheckpoint(f"its format version is {version!r}")
    if version > known_version:
        raise NewerCheckpoint(version, known_version)
    return card


def config_in(card: Mapping[str, object]) -> RewardConfig:
    """The settings of the network. Raises DamagedCheckpoint if there are none, or none that can be."""
    settings = card.get("config")
    if not isinstance(settings, dict):
        raise DamagedCheckpoint("its card holds no settings")
    try:
        return RewardConfig.from_dict(settings)
    except InvalidConfig as error:
        raise DamagedCheckpoint(str(error)) from error


def metrics_in(card: Mapping[str, object]) -> dict[str, float]:
    """Raises DamagedCheckpoint if there are none, or one is no number."""
    metrics = card.get("metrics")
    if not isinstance(metrics, dict) or not all(isinstance(value, int | float) for value in metrics.values()):
        raise DamagedCheckpoint("its card holds no metrics")
    return {str(name): float(value) for name, value in metrics.items()}
