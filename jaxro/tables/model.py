"""Tables of model points: CSV text in, `ModelPoints` out, or one clear error.

point, X, Y, Z, as `jaxro orient` and `jaxro clean` write them (points.csv: pair, and
the unit of the model behind the names, as in X_bases); optionally sigma, or sX, sY, sZ,
the standard deviations of a point. Beside these own_XX to own_ZZ and common_X1 to
common_Z5 may stand, all of them: the error of a point is

    own z + common e,

with own, a lower triangular matrix, and standard normal numbers: three of each point, z,
and five that all points of the pair share, e.
"""

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from . import fields
from .fields import Columns, TableError
from .ground import AXES, DEVIATIONS, SHORT

OWN = tuple(f"own_{a}{b}" for k, a in enumerate("xyz") for b in "xyz"[: k + 1])
COMMON = tuple(f"common_{axis}{k}" for axis in "xyz" for k in range(1, 6))
FACTORS = (*OWN, *COMMON)
NUMBERS = (*AXES, *DEVIATIONS, "sigma", *FACTORS)
WITH_UNIT = re.compile(r"(s?[xyz]|own_[xyz]{2}|common_[xyz][1-5])_(\w+)")
SHOWN = 5
"""Names that an error tells of a longer list."""


class Factors(NamedTuple):
    """What makes the errors of model points of standard normal numbers: three of each
    point for itself, and five that all share."""

    own: Float[np.ndarray, "point 3 3"]
    common: Float[np.ndarray, "point 3 5"]


@dataclass(frozen=True)
class ModelPoints:
    """The points of one model with their names: coordinates and their standard
    deviations (None where the table has none), the line of each; the name of the pair,
    and the unit of the coordinates ("" where the table does not say it); the `factors` of
    the errors, if the table has them."""

    file: str
    pair: str
    unit: str
    names: list[str]
    coordinates: Float[np.ndarray, "point 3"]
    deviations: Float[np.ndarray, "point 3"] | None
    lines: Int[np.ndarray, " point"]
    factors: Factors | None = None


def read(path: Path, pair: str | None = None) -> ModelPoints:
    """The model of a file, or that of a `pair` where there are several. Raises
    TableError."""
    return parse(fields.read_text(path), str(path), path.stem, pair)


def parse(
    text: str,
    file: str,
    name: str,
    pair: str | None = None,
) -> ModelPoints:
    """The model of CSV text; `name`: its name where the table has no column pair.
    Raises TableError."""
    columns, unit = _columns(text)
    models: dict[str, dict[str, tuple[int, list[float]]]] = {}
    there: tuple[str, ...] = ()
    line = 1
    given = io.StringIO(text, newline="")
    for line, cells in fields.lines_of(given, file, columns):
        there = tuple(column for column in NUMBERS if column in cells)
        own = cells.get("pair", name)
        if "pair" in cells:
            fields.name(own, file, line, "pair")
        point = fields.name(cells["point"], file, line, "point")
        points = models.setdefault(own, {})
        if point in points:
            raise TableError(
                file,
                line=line,
                column="point",
                found=f"{point!r} a second time (first on line {points[point][0]})",
                expected="each point once in a model",
            )
        if pair is None or own == pair:
            numbers = [_number(cells[c], file, line, c) for c in there]
            points[point] = line, numbers
        else:
            points[point] = line, []
    if not models:
        raise TableError(
            file,
            line=line + 1,
            found="no points",
            expected=f"{columns}, and one line for each model point below them",
        )
    chosen = _choose(list(models), pair, file)
    points = models[chosen]
    values = np.array([numbers for _, numbers in points.values()], float)
    at = dict(zip(there, values.T, strict=True))
    return ModelPoints(
        file=file,
        pair=chosen,
        unit=unit,
        names=list(points),
        coordinates=np.stack([at[axis] for axis in AXES], axis=1),
        deviations=_deviations(at, file),
        lines=np.array([line for line, _ in points.values()]),
        factors=_factors(at, file),
    )


def _columns(text: str) -> tuple[Columns, str]:
    """The columns of a table with this header, and the unit that this says."""
    separator, given = fields.find_separator(io.StringIO(text, newline=""))
    lines = csv.reader(given, delimiter=separator)
    header = next((row for row in lines if any(e.strip() for e in row)), [])
    short, units = dict(SHORT), []
    for entry in header:
        found = WITH_UNIT.fullmatch(entry.strip().lower())
        if found:
            short[found[0]] = found[1]
            units.append(found[2])
    columns = Columns(
        ("point", *AXES),
        ("pair", *DEVIATIONS, "sigma", *FACTORS),
        short,
        texts=("pair", "point"),
    )
    return columns, units[0] if units else ""


def _choose(names: list[str], pair: str | None, file: str) -> str:
    """The model that is asked for. Raises TableError."""
    some = ", ".join(map(repr, names[:SHOWN])) + (", ..." if names[SHOWN:] else "")
    if pair is None and len(names) > 1:
        raise TableError(
            "--pair",
            found=f"models of {len(names)} pairs in {file}",
            expected=f"the name of one of them: {some}",
        )
    if pair is not None and pair not in names:
        expected = f"a pair of {file}: {some}"
        raise TableError("--pair", found=repr(pair), expected=expected)
    return names[0] if pair is None else pair


def _deviations(
    at: dict[str, np.ndarray], file: str
) -> Float[np.ndarray, "point 3"] | None:
    """Standard deviations of the coordinates, from either kind of columns. Raises
    TableError."""
    there = [column for column in DEVIATIONS if column in at]
    if not there and "sigma" not in at:
        return None
    if there and ("sigma" in at or len(there) < len(DEVIATIONS)):
        raise TableError(
            file,
            column=there[0],
            found=f"it {'beside' if 'sigma' in at else 'without'} other deviations",
            expected="sX, sY and sZ, or sigma for all three",
        )
    columns = there or ["sigma"] * 3
    return np.stack([at[column] for column in columns], axis=1)


def _factors(at: dict[str, np.ndarray], file: str) -> Factors | None:
    """The factors of the errors. Raises TableError where some of them are missing."""
    there = [column for column in FACTORS if column in at]
    if not there:
        return None
    missing = [column for column in (*DEVIATIONS, *FACTORS) if column not in at]
    if missing:
        raise TableError(
            file,
            column=there[0],
            found=f"it without {missing[0]}",
            expected="all of own_XX to own_ZZ and common_X1 to common_Z5 with sX, sY and "
            "sZ, or none of them",
        )
    rows, places = np.tril_indices(3)
    own = np.zeros((len(at[there[0]]), 3, 3))
    own[:, rows, places] = np.stack([at[column] for column in OWN], axis=1)
    common = np.stack([at[column] for column in COMMON], axis=1)
    return Factors(own, common.reshape(-1, 3, 5))


def _number(text: str, file: str, line: int, column: str) -> float:
    """A number; a standard deviation is positive. Raises TableError."""
    value = fields.number(
        text, file, line, column, "; delete the line to leave the point out"
    )
    if column in (*DEVIATIONS, "sigma") and value <= 0:
        raise TableError(
            file,
            line=line,
            column=column,
            found=repr(text),
            expected="a positive standard deviation in the unit of the model",
        )
    return value
