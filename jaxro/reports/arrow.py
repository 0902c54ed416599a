"""Columns as Arrow tables, which become Parquet files; needs pyarrow."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from .columns import Column, Units


def arrow_table(
    columns: Sequence[Column],
    values: dict[str, Any],
    units: Units,
    kind: str = "parquet",
) -> Any:
    """An Arrow table of the columns that have values, and that this kind of file has."""
    return pa.table(
        {
            column.head(units): arrow_column(
                values[column.source or column.name], column.names
            )
            for column in columns
            if column.only in ("", kind) and (column.source or column.name) in values
        }
    )


def arrow_column(values: Any, names: Mapping[int, str] | None = None) -> Any:
    """An Arrow column, null where a value does not exist; `names` of whole numbers."""
    if not isinstance(values, np.ndarray):
        return values
    if names:
        return _texts(values, names)
    if values.dtype.kind == "O":
        return pa.array(values, pa.string())
    if values.dtype.kind == "f":
        return pa.array(values, from_pandas=bool(np.isnan(values).any()))
    missing = values < 0 if values.dtype.kind == "i" and np.any(values < 0) else None
    return pa.array(values > 0 if values.dtype == np.int8 else values, mask=missing)


def _texts(numbers: np.ndarray, names: Mapping[int, str]) -> Any:
    """Names instead of numbers, each of them stored once."""
    known = pa.array([names.get(i, "") for i in range(max(names) + 1)])
    codes = pa.array(numbers.astype(np.int8), mask=numbers < 0)
    return pa.DictionaryArray.from_arrays(codes, known)
