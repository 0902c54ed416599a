"""Results as Arrow tables, which pandas, polars and duckdb read without copying.

    table = to_arrow(results, "residuals")
    pandas.DataFrame.from_arrow(table), polars.DataFrame(table), duckdb.sql("FROM table")

A table has the Arrow PyCapsule interface (`__arrow_c_stream__`). Its columns have the
names of the CSV files that `--out` writes, with the unit in the name; the unit stands
in the metadata of the column, too, as `unit`. What does not exist is null. Needs
pyarrow (the extra `tables`).
"""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import jax
import numpy as np

from ..orientation.result import Orientation
from ..reports.columns import Column, Units, columns_of, element_names, is_given
from ..reports.model import Results
from ..reports.reader import report_all

NO_NAMES = Units(photo="", model="", sigma0="")
"""The units of an orientation, which does not know what they are called."""


def to_arrow(result: Any, table: str = "", *, units: Units = NO_NAMES) -> Any:
    """A table of a result, as a `pyarrow.Table`.

    `result` and its tables, of which the first is the default: an `Orientation` of a
    pair or of a batch ("elements", but for what needs the pair); `Results` of pairs
    ("elements", "residuals", "points", "reliability"); a finished block ("photos",
    "points", "residuals", ...); a finished calibration ("cameras", "stations", ...).
    `units`: those of an
    `Orientation`. Raises ValueError for a table that the result has not got, TypeError
    for a result without tables.
    """
    if find_spec("pyarrow") is None:
        raise ImportError("Arrow tables need pyarrow: pip install 'jaxro[tables]'")
    if isinstance(result, Orientation):
        columns = columns_of(_chosen(table, ["elements"]), type(result.elements))
        return _of_columns(columns, _pair_values(result), units)
    if isinstance(result, Results):
        name = _chosen(table, list(dict.fromkeys(["elements", *result.of_points])))
        return _of_columns(*result.written(name), result.units)
    return _of_files(table, result)


def _of_columns(columns: Sequence[Column], values: dict[str, Any], units: Units) -> Any:
    """The table of a CSV file, with the units of its columns."""
    import pyarrow as pa

    from ..reports.arrow import arrow_table

    table = arrow_table(columns, values, units, "csv")
    told = {column.head(units): units.of(column.kind) for column in columns}
    fields = [
        field.with_metadata({"unit": told[field.name]}) if told[field.name] else field
        for field in table.schema
    ]
    return table.cast(pa.schema(fields))


def _pair_values(oriented: Orientation) -> dict[str, Any]:
    """The columns of the pairs, of an orientation with any leading axes."""
    axes = np.ndim(oriented.usable)
    flat = lambda a: np.reshape(np.asarray(a), (-1, *np.shape(a)[axes:]))
    data = jax.tree.map(flat, (oriented.elements, oriented.cofactor, oriented.sigma0))
    found, deviations = report_all(*data)
    usable, system = flat(oriented.usable), type(oriented.elements)
    hide = lambda a: np.where(usable, np.ravel(a), np.nan)
    values: dict[str, Any] = {
        "result": flat(oriented.result._value),
        "degrees_of_freedom": flat(oriented.degrees_of_freedom),
        "iterations": flat(oriented.iterations),
        "m_q": hide(oriented.m_q),
        "sigma0": hide(oriented.sigma0),
    }
    for name, value, sd in zip(element_names(system), found, deviations, strict=True):
        values[name] = hide(value)
        if not is_given(name, system):
            values[f"sd_{name}"] = hide(sd)
    return values


def _of_files(table: str, result: Any) -> Any:
    """A table of a finished block or calibration."""
    import pyarrow as pa

    from ..reports import block_files, block_model, calibration_files, calibration_model
    from ..reports.arrow import arrow_column

    if isinstance(result, block_model.Done):
        tables = block_files.tables(result)
        chosen = tables[_chosen(table, list(tables))]
        return pa.table({name: arrow_column(a) for name, a in chosen.items()})
    if isinstance(result, calibration_model.Done):
        tables = calibration_files.tables(result)
        names = [name.removesuffix(".csv") for name in tables]
        return pa.Table.from_pylist(tables[f"{_chosen(table, names)}.csv"])
    raise TypeError(
        f"to_arrow: {type(result).__name__} has no tables; an Orientation, Results of "
        "pairs, a finished block or a finished calibration has"
    )


def _chosen(table: str, names: list[str]) -> str:
    """The table of this name, the first one of none."""
    if not names:
        raise ValueError("to_arrow: the result is not usable and has no tables")
    if table and table not in names:
        raise ValueError(f"to_arrow: no table {table!r}; there are {', '.join(names)}")
    return table or names[0]
