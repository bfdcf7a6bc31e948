"""Comparisons and datasets of any origin as our Parquet tables."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mapt.preferences.dataset import FloatArray, IntArray, PreferenceDataset
from mapt.preferences.formats.records import Comparisons, SegmentRecords, records_in_batches
from mapt.preferences.formats.table_schemas import LabelRow, QueryRow, SegmentRow
from mapt.preferences.formats.table_writer import TableWriter
from mapt.preferences.storage import SegmentFolder, SegmentLayout


def write_tables(path: Path | str, comparisons: Comparisons, *, about: Mapping[str, Any] | None = None) -> None:
    """Write comparisons that come from elsewhere as our tables.

    Raises:
        AlreadyExists: if there is something at `path`.
    """
    layout = comparisons.records.layout()
    with TableWriter(path, layout, about=about) as tables:
        _write(tables, [comparisons.records], comparisons.pairs, comparisons.labels)


def write_dataset(path: Path | str, dataset: PreferenceDataset, *, about: Mapping[str, Any] | None = None) -> None:
    """Write a dataset as our tables, in the memory of some hundred segments where they lie on disk.

    Raises:
        AlreadyExists: if there is something at `path`.
    """
    source = dataset.segments
    layout = (
        source.layout
        if isinstance(source, SegmentFolder)
        else SegmentLayout(source.n_steps, source.n_agents, source.observation_dim, source.action_dim)
    )
    with TableWriter(path, layout, about=about) as tables:
        _write(tables, records_in_batches(source), dataset.pairs, dataset.labels)


def _write(tables: TableWriter, batches: Iterable[SegmentRecords], pairs: IntArray, labels: FloatArray) -> None:
    written = 0
    for records in batches:
        tables.add_segments([SegmentRow(f"segment-{written + index}") for index in range(len(records))], records)
        written += len(records)
    tables.add_queries(
        QueryRow(f"query-{index}", f"segment-{first}", f"segment-{second}")
        for index, (first, second) in enumerate(pairs.tolist())
    )
    tables.add_labels(
        LabelRow(f"query-{index}", "imported", "skip", None)
        if np.isnan(label)
        else LabelRow(f"query-{index}", "imported", "label", label)
        for index, label in enumerate(labels.tolist())
    )
