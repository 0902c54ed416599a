"""The files of --out, in full precision: elements.csv, residuals.csv, points.csv,
reliability.csv and summary.json.

A number is written as its shortest text that reads back as the same float. What does
not exist is an empty cell, null in JSON. Headers carry the units; angles are degrees.
"""

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ..assessment import Pattern
from ..batches.closures import Closures
from ..geometry.pairs import Camera
from ..orientation.pure_rotation import ANGLES, PureRotation
from ..tables.measured import to_list
from .columns import TABLES, Column, Units, head
from .model import Element, One, Results


def texts(results: Results, summary: dict[str, Any]) -> dict[str, str]:
    """The content of the files by name."""
    written = {
        f"{name}.csv": table_text(*results.written(name), results.units)
        for name in TABLES
    }
    return written | {"summary.json": json_text(summary_of(results, summary))}


def table_text(columns: Sequence[Column], values: dict[str, Any], units: Units) -> str:
    """Columns as CSV text; those without values are left out."""
    there = [
        column
        for column in columns
        if column.only in ("", "csv") and (column.source or column.name) in values
    ]
    cells = [_cells(column, values[column.source or column.name]) for column in there]
    header = [column.head(units) for column in there]
    return csv_text([header, *zip(*cells, strict=True)])


def _cells(column: Column, values: Any) -> list[Any]:
    """The values of a column as Python objects: None for what CSV text leaves empty."""
    found = to_list(values)
    if column.names:
        return [column.names.get(number) for number in found]
    if column.infinity:
        return [column.infinity if v == math.inf else v for v in found]
    if isinstance(values, np.ndarray) and values.dtype.kind == "i":
        truth = {1: True, 0: False} if values.dtype == np.int8 else {}
        return [None if value < 0 else truth.get(value, value) for value in found]
    return found


def rows_text(rows: Sequence[dict[str, Any]]) -> str:
    """Rows with the same keys, which are the header, as CSV text."""
    return csv_text([list(rows[0]), *(list(row.values()) for row in rows)])


def columns_text(columns: dict[str, Any]) -> str:
    """Columns of one length as CSV text."""
    return csv_text([list(columns), *zip(*columns.values(), strict=True)])


def csv_text(rows: Iterable[Sequence[Any]]) -> str:
    """Rows as CSV text, the first of them the header: true and false for truths, an
    empty field for what does not exist."""

    def cell(value: Any) -> Any:
        if isinstance(value, bool):
            return str(value).lower()
        return value if _exists(value) else ""

    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    quoting = csv.writer(text, lineterminator="\n", quoting=csv.QUOTE_ALL)
    for row in rows:
        cells = [cell(value) for value in row]
        # this one line end csv leaves without quotes
        ends = any(isinstance(value, str) and "\r" in value for value in cells)
        (quoting if ends else writer).writerow(cells)
    return text.getvalue()


def _exists(value: Any) -> bool:
    return value is not None and not (
        isinstance(value, float) and not math.isfinite(value)
    )


def _pattern(pattern: Pattern | None, units: Units) -> dict[str, float] | None:
    """The test of a pattern in the residuals."""
    if pattern is None:
        return None
    told = {
        "probability": pattern.probability,
        "rho": pattern.rho,
        head("length", units.photo): pattern.length,
    }
    return {name: float(value) for name, value in told.items()}


def _closures(closures: Closures | None) -> dict[str, Any] | None:
    """How the triplets of photos close, all together and the worst one."""
    if closures is None:
        return None
    worst = closures.worst
    return {
        "triplets": len(closures.photos),
        "factor": math.sqrt(closures.ratio),
        "degrees_of_freedom": closures.freedom,
        "probability": closures.probability,
        "worst": {
            "photos": list(closures.photos[worst]),
            "angle": math.degrees(closures.angles[worst]),
            "factor": math.sqrt(closures.squares[worst] / 3),
        },
    }


def summary_of(results: Results, summary: dict[str, Any]) -> dict[str, Any]:
    """The content of summary.json."""
    units = asdict(results.units) | {
        "sigma0": results.units.sigma0 or None,
        "angles": "deg",
    }
    return {
        **summary,
        "units": units,
        "pattern": _pattern(results.pattern, results.units),
        "growth_of_deviations": results.growth,
        "closures": _closures(results.closures),
        "pairs": [_pair(one) for one in results],
    }


def _pair(one: One) -> dict[str, Any]:
    """What summary.json says of a pair."""
    return {
        "pair": one.name,
        "result": one.result,
        "usable": one.usable,
        "advice": one.advice,
        "causes": one.causes,
        "points": one.count,
        "degrees_of_freedom": one.value("degrees_of_freedom"),
        "iterations": one.value("iterations"),
        "m_q": one.value("m_q"),
        "sigma0": one.value("sigma0"),
        "curvature": one.value("curvature"),
        "elements": {e.name: _element(e) for e in one.elements},
        "correlations": one.correlations,
        "rotation": _rotation(one.rotation),
        "pattern": _pattern(one.pattern, one.results.units),
        "promise": _promise(one),
        "cameras": [_camera(camera) for camera in one.cameras],
    }


def _promise(one: One) -> dict[str, Any] | None:
    """What simulation says that the intervals of a cleaned pair hold."""
    told = one.promise
    if told is None:
        return None
    known = one.results.sigma_known
    each = told.intervals_known if known else told.intervals
    names = [e.name for e in one.elements]
    return {
        "repetitions": told.repetitions,
        "confidence": told.confidence,
        "answered": float(told.answered),
        "exactly_right": float(told.exactly_right),
        "without_wrong": float(told.without_wrong),
        "alike": float(told.alike),
        "region": float(told.coverage_known if known else told.coverage),
        "intervals": dict(zip(names, map(float, each), strict=True)),
    }


def _rotation(rotation: PureRotation | None) -> dict[str, Any] | None:
    """The rotation of a pair without a base, and the deviations of its turns about the
    axes of the left photo."""
    if rotation is None:
        return None
    return {
        "unit": "deg",
        **dict(zip(ANGLES, np.degrees(rotation.angles).tolist(), strict=True)),
        "sd": dict(zip("xyz", np.degrees(rotation.deviations).tolist(), strict=True)),
        "sigma0": float(rotation.sigma0),
        "degrees_of_freedom": int(rotation.degrees_of_freedom),
    }


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "focal": camera.focal,
        "principal_point": list(camera.principal_point),
        "pixel_size": camera.pixel_size,
        "y_down": camera.y_down,
    }


def _element(e: Element) -> dict[str, Any]:
    value = {"unit": e.unit or None, "value": e.value, "sd": e.deviation}
    if e.half_width is not None:
        value |= {"half_width": e.half_width}
    if e.by_likelihood is not None:
        value |= {"by_likelihood": list(e.by_likelihood)}
    return value


def json_text(value: Any) -> str:
    """The value as JSON."""
    return (
        json.dumps(_clean(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    )


def _clean(value: Any) -> Any:
    """The value with null for every number that does not exist."""
    if isinstance(value, dict):
        return {key: _clean(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(entry) for entry in value]
    return value if _exists(value) else None
