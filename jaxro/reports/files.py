"""The files of --out, in full precision: elements.csv, residuals.csv, points.csv,
reliability.csv and summary.json.

All or none in a new folder; in one that is there each file takes the place of the old
one when all are written.

A number is written as its shortest text that reads back as the same float. What does
not exist is an empty cell, null in JSON. Headers carry the units; angles are degrees.
"""

import csv
import io
import json
import math
from typing import Any

from ..assessment import Pattern
from . import reliability as reading
from .solutions import Element, Solution, Units, pattern_of_all, with_pattern


def texts(
    solved: list[Solution], units: Units, summary: dict[str, Any]
) -> dict[str, str]:
    """The content of the files by name."""
    return {
        "elements.csv": csv_text(_element_rows(solved, units)),
        "residuals.csv": csv_text(_point_rows(solved, RESIDUALS, units)),
        "points.csv": csv_text(_point_rows(solved, POINTS, units)),
        "reliability.csv": csv_text(reading.file_rows(solved, units)),
        "summary.json": _json(solved, units, summary),
    }


RESIDUALS = (
    "q",
    "v_x_left",
    "v_y_left",
    "v_x_right",
    "v_y_right",
    "redundancy",
    "in_front",
)
POINTS = ("X", "Y", "Z")


def _element_rows(solved: list[Solution], units: Units) -> list[list[Any]]:
    header: list[Any] = ["pair", "result", "points", "degrees_of_freedom", "iterations"]
    for e in solved[0].elements:
        header += [head(e.name, e.unit)] + (
            [] if e.deviation is None else [head(f"sd_{e.name}", e.unit)]
        )
    rows: list[list[Any]] = [
        [*header, head("m_q", units.photo), head("sigma0", units.sigma0), "advice"]
    ]
    for s in solved:
        row = [s.measured.name, s.result, len(s.measured.points), *_counts(s).values()]
        for e in s.elements:
            row += [e.value] + ([] if e.deviation is None else [e.deviation])
        rows.append([*row, s.m_q, s.sigma0, s.advice])
    return rows


def _point_rows(
    solved: list[Solution], keys: tuple[str, ...], units: Units
) -> list[list[Any]]:
    unit = {"redundancy": "", "in_front": "", **dict.fromkeys(POINTS, units.model)}
    rows: list[list[Any]] = [
        ["pair", "point", *(head(key, unit.get(key, units.photo)) for key in keys)]
    ]
    for s in solved:
        rows += [
            [s.measured.name, values["point"], *(values[key] for key in keys)]
            for values in s.points
        ]
    return rows


def head(name: str, unit: str) -> str:
    """The header of a column."""
    return f"{name}_{unit}" if unit else name


def _counts(s: Solution) -> dict[str, int]:
    o = s.orientation
    return {
        "degrees_of_freedom": int(o.degrees_of_freedom),
        "iterations": int(o.iterations),
    }


def _exists(value: Any) -> bool:
    return value is not None and not (
        isinstance(value, float) and not math.isfinite(value)
    )


def csv_text(rows: list[list[Any]]) -> str:
    """Rows as CSV, the first of them the header."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(
        [
            str(value).lower()
            if isinstance(value, bool)
            else value
            if _exists(value)
            else ""
            for value in row
        ]
        for row in rows
    )
    return text.getvalue()


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


def _json(solved: list[Solution], units: Units, summary: dict[str, Any]) -> str:
    tested = {id(s) for s in with_pattern(solved)}
    pairs = [
        {
            "pair": s.measured.name,
            "result": s.result,
            "usable": s.usable,
            "advice": s.advice,
            "points": len(s.measured.points),
            **_counts(s),
            "m_q": s.m_q,
            "sigma0": s.sigma0,
            "elements": {e.name: _element(e) for e in s.elements},
            "correlations": s.correlations,
            "pattern": _pattern(s.pattern if id(s) in tested else None, units),
            "cameras": [
                {
                    "focal": c.focal,
                    "principal_point": list(c.principal_point),
                    "pixel_size": c.pixel_size,
                    "y_down": c.y_down,
                }
                for c in s.cameras
            ],
        }
        for s in solved
    ]
    whole = {
        **summary,
        "units": {
            "photo": units.photo,
            "model": units.model,
            "sigma0": units.sigma0 or None,
            "angles": "deg",
        },
        "pattern": _pattern(pattern_of_all(solved), units),
        "pairs": pairs,
    }
    return json_text(whole)


def _element(e: Element) -> dict[str, Any]:
    value = {"unit": e.unit or None, "value": e.value, "sd": e.deviation}
    return value if e.half_width is None else value | {"half_width": e.half_width}


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
