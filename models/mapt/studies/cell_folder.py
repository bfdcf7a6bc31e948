"""Finished cells on disk: what makes a killed study go on where it was."""

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

import mapt.preferences
import mapt.rewards
from mapt.studies.cell import CellSettings
from mapt.studies.errors import DamagedCell
from mapt.studies.examination import Examination

FORMAT_VERSION = 1
_ARRAYS = ("logits", "labels", "clean_labels", "pairs")
_KEY_LENGTH_SHOWN = 12


@dataclass(frozen=True, slots=True)
class Cell:
    """A finished cell."""

    settings: CellSettings
    result: Examination
    #: which state of the library's code made it, see `code_fingerprint`
    code: str


class CellFolder:
    """One JSON file and one of arrays for each cell, named by the key of its settings."""

    def __init__(self, folder: Path) -> None:
        self.path = folder

    def read(self, settings: CellSettings) -> Cell | None:
        """The cell of exactly these settings, or None if it was not made yet.

        Raises:
            DamagedCell: if its files are not as they were written.
        """
        card_path, arrays_path = self._paths(settings)
        if not card_path.exists():
            return None
        try:
            card = json.loads(card_path.read_text())
            arrays = load_file(arrays_path)
            if card["format_version"] != FORMAT_VERSION:
                raise DamagedCell(card_path, f"its format is {card['format_version']}, known is {FORMAT_VERSION}")
            if card["settings"] != json.loads(json.dumps(settings.to_dict())):
                raise DamagedCell(card_path, "its settings are not those of its name")
            return Cell(settings, Examination(card["metrics"], *(arrays[name] for name in _ARRAYS)), card["code"])
        except (json.JSONDecodeError, KeyError, TypeError, OSError, SafetensorError) as error:
            raise DamagedCell(card_path, f"{type(error).__name__}: {error}") from error

    def write(self, settings: CellSettings, result: Examination, code: str) -> None:
        """Keep a cell; its card comes last and whole, so that a kill leaves no half of one."""
        self.path.mkdir(parents=True, exist_ok=True)
        card_path, arrays_path = self._paths(settings)
        card = {
            "format_version": FORMAT_VERSION,
            "settings": asdict(settings),
            "metrics": dict(result.metrics),
            "code": code,
        }
        partial = arrays_path.with_suffix(".partial")
        save_file({name: getattr(result, name) for name in _ARRAYS}, partial)
        os.replace(partial, arrays_path)
        partial = card_path.with_suffix(".partial")
        partial.write_text(json.dumps(card, indent=1, sort_keys=True, allow_nan=False) + "\n")
        os.replace(partial, card_path)

    def _paths(self, settings: CellSettings) -> tuple[Path, Path]:
        return self.path / f"{settings.key}.json", self.path / f"{settings.key}.safetensors"


@cache
def code_fingerprint() -> str:
    """A short name for the state of the code that trains and judges.

    It is recorded with a cell, and no part of its key: a corrected docstring would else undo a night's work. The
    table says when its cells come from several states.
    """
    digest = hashlib.sha256()
    for package in (mapt.preferences, mapt.rewards):
        for path in sorted(Path(package.__path__[0]).rglob("*.py")):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:_KEY_LENGTH_SHOWN]
