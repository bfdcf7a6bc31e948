"""A table of plain rows as a Parquet file."""

import io
from collections.abc import Iterable, Mapping
from datetime import datetime

import pyarrow as pa
import pyarrow.parquet as pq

_TYPES: Mapping[type, pa.DataType] = {
    int: pa.int64(),
    float: pa.float64(),
    str: pa.string(),
    bool: pa.bool_(),
    datetime: pa.timestamp("us", tz="UTC"),
}


def parquet_table(columns: Mapping[str, type], rows: Iterable[Mapping[str, object]]) -> bytes:
    """A Parquet file with these rows.

    Args:
        columns: name -> int, float, str, bool, or datetime for a time with a time zone.
        rows: their values; one that is missing or None is null.
    """
    schema = pa.schema([(name, _TYPES[kind]) for name, kind in columns.items()])
    output = io.BytesIO()
    pq.write_table(pa.Table.from_pylist([dict(row) for row in rows], schema=schema), output)
    return output.getvalue()
