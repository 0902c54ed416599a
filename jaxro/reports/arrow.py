"""Columns as Arrow tables, which become Parquet files; needs pyarrow."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from .columns import Column, Units


def arrow_table(columns: Sequence[Column], values: dict[str, Any], units: Units) -> Any:
    """An Arrow table of the columns that have values."""
    return pa.table(
        {
            column.head(units): _column(column, values[column.source or column.name])
            for column in columns
            if column.only in ("", "parquet")
            and (column.source or column.name) in values
        }
    )


def _column(column: Column, values: Any) -> Any:
    """An Arrow column, null where a value does not exist."""
    if not isinstance(values, np.ndarray):
        return values
    if column.names:
        return _texts(values, column.names)
    if values.dtype.kind == "f":
        return pa.array(values, from_pandas=bool(np.isnan(values).any()))
    missing = values < 0 if values.dtype.kind == "i" and np.any(values < 0) else None
    return pa.array(values > 0 if values.dtype == np.int8 else values, mask=missing)


def _texts(numbers: np.ndarray, names: Mapping[int, str]) -> Any:
    """Names instead of numbers, each of them stored once."""
    known = pa.array([names.get(i, "") for i in range(max(names) + 1)])
    return pa.DictionaryArray.from_arrays(pa.array(numbers.astype(np.int8)), known)
