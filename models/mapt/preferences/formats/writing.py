"""One function that writes an export of an experiment for every other program that `reading` reads."""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

from mapt.preferences.dataset import PreferenceDataset
from mapt.preferences.formats.d4rl import write_d4rl
from mapt.preferences.formats.imitation import write_imitation
from mapt.preferences.formats.minari import write_minari
from mapt.preferences.formats.offline_labels import write_offline_labels
from mapt.preferences.formats.reading import ForeignFormat
from mapt.preferences.formats.records import Comparisons, Episode, concatenate, episodes_of, records_in_batches
from mapt.preferences.formats.reference import write_reference
from mapt.preferences.formats.tables import PreferenceTables


def write_foreign(
    path: Path | str, tables: PreferenceTables, format: ForeignFormat, *, discrete: bool, name: str = "accord/export-v0"
) -> None:
    """Write tables in the format of another program. `imitation` and `offline` hold all segments in memory.

    mapt, imitation and offline have the labelled pairs of `PreferenceTables.load`; minari and d4rl have every segment
    as an episode, without labels.

    Args:
        path: a file for mapt, imitation and d4rl, a folder for offline and minari.
        discrete: whether the actions are one-hot. They are written as indices, but for offline and d4rl, whose
            programs have continuous actions only.
        name: identifier of Minari's dataset.

    Raises:
        AlreadyExists: if `path` exists.
        NotEnoughPairs: if the format has labels, and there are none.
        NotRepresentable: if the format cannot hold a label, a decisive agent or segments of different lengths.
        InvalidFile: if a table is damaged.
    """
    path = Path(path)
    if format == "minari":
        write_minari(path, _episodes(tables), dataset_id=name, discrete=discrete)
        return
    if format == "d4rl":
        write_d4rl(path, _episodes(tables))
        return
    with TemporaryDirectory(prefix="mapt-segments-", dir=path.parent) as scratch:
        dataset = tables.load(Path(scratch, "segments"))
        match format:
            case "mapt":
                write_reference(path, dataset, discrete=discrete)
            case "imitation":
                write_imitation(path, _comparisons(dataset), discrete=discrete)
            case "offline":
                write_offline_labels(path, _comparisons(dataset))


def _episodes(tables: PreferenceTables) -> Iterator[Episode]:
    return chain.from_iterable(episodes_of(records) for _, records in tables.segments())


def _comparisons(dataset: PreferenceDataset) -> Comparisons:
    records = concatenate(list(records_in_batches(dataset.segments)))
    return Comparisons(records, dataset.pairs, dataset.labels)
