"""Tables of measurements between the points of a network: CSV text in, `Measurements`
out, or one clear error.

kind          height, distance (in plan), slope, direction, angle, azimuth, zenith or
              vector; without this column all are of the kind that the columns tell:
              difference is that of heights, dX,dY,dZ are vectors
from, to      names of the points; an angle at `from` is that from `to` to `other`
value         what was measured (difference: of heights)
sigma         its standard deviation, in the same unit
length_km     in place of sigma: the length of a line of levelling, whose variance is
              proportional to it
dX, dY, dZ    of a vector, with sX, sY, sZ (or sigma) and cXY, cXZ, cYZ
set           of directions: which of them were measured together; without it all from
              one point
from_above    heights of the instrument over `from` and of the targets over `to` and
to_above      `other`
other_above
"""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..surveys.geodetic import KINDS
from . import fields
from .fields import Columns, TableError
from .survey_checks import Row

VECTOR = ("dx", "dy", "dz")
SIGMAS = ("sx", "sy", "sz")
COVARIANCES = ("cxy", "cxz", "cyz")
ENDS = ("from", "to", "other")
ABOVE = tuple(f"{end}_above" for end in ENDS)
NETWORK = Columns(
    ("from", "to"),
    (
        *("kind", "value", "difference", "sigma", "length_km", "other", "set"),
        *(*VECTOR, *SIGMAS, *COVARIANCES, *ABOVE),
    ),
    texts=("kind", "from", "to", "other", "set"),
)
WORDS = tuple(name for name, kind in KINDS.items() if kind.ends > 1)


@dataclass(frozen=True)
class Measurement:
    """One line: its kind, the names of its points, what was measured, the lower triangle
    of the Cholesky factor of its covariance matrix, and the set of a direction. `line`
    of the file. `is_relative`: it has a weight, and no standard deviation. `above`: the
    heights of instrument and targets above their points."""

    kind: str
    points: tuple[str, ...]
    values: Float[np.ndarray, " m"]
    root: Float[np.ndarray, "m m"]
    set: str
    line: int
    is_relative: bool = False
    above: tuple[float, ...] = ()


def read(path: Path, sigma: float | None) -> list[Measurement]:
    """The measurements of a file; `sigma`: the standard deviation of all that have none
    of their own, of a kilometre of levelling. Raises TableError."""
    return parse(fields.read_text(path), str(path), sigma)


def parse(text: str, file: str, sigma: float | None) -> list[Measurement]:
    """The measurements of CSV text. Raises TableError."""
    found, line = [], 1
    given = io.StringIO(text, newline="")
    for line, cells in fields.lines_of(given, file, NETWORK):
        found.append(_measurement(Row(file, line, dict(cells)), sigma))
    if not found:
        raise TableError(
            file,
            line=line + 1,
            found="no measurements",
            expected=f"{NETWORK}, and one line a measurement",
        )
    return found


def _measurement(row: Row, sigma: float | None) -> Measurement:
    kind = _kind(row)
    columns = ENDS[: KINDS[kind].ends]
    for column in columns:
        if column not in row.cells:
            raise TableError(
                row.file,
                column=column,
                found="no such column",
                expected=f"the {KINDS[kind].ends} points of each {kind}",
            )
    points = tuple(
        fields.name(row.cells[column], row.file, row.line, column) for column in columns
    )
    if len(set(points)) < len(points):
        raise row.error(
            columns[-1],
            found=repr(points[-1]),
            expected="another point than in the columns before",
        )
    if kind == "vector":
        values = np.array([_number(row, column) for column in VECTOR])
        root = _root_of_vector(row, sigma)
    else:
        column = "difference" if "difference" in row.cells else "value"
        values = np.array([_number(row, column)])
        root = np.array([[_sigma(row, sigma)]])
    name = row.cells.get("set", "") or points[0]
    relative = sigma is None and not row.cells.get("sigma") and kind != "vector"
    above = tuple(
        _number(row, column) if row.cells.get(column) else 0.0
        for column in ABOVE[: len(points)]
    )
    return Measurement(kind, points, values, root, name, row.line, relative, above)


def _kind(row: Row) -> str:
    """The kind of a line, by its column or by what the columns tell."""
    cells = row.cells
    if "kind" in cells:
        kind = cells["kind"].lower()
        if kind in WORDS:
            return kind
        raise row.error("kind", found=repr(cells["kind"]), expected=", ".join(WORDS))
    if "difference" in cells:
        return "height"
    if "dx" in cells:
        return "vector"
    raise TableError(
        row.file,
        column="kind",
        found="no such column",
        expected=f"what each line is: {', '.join(WORDS)}; or a column difference (of "
        "heights), or dX,dY,dZ (vectors)",
    )


def _sigma(row: Row, sigma: float | None) -> float:
    """The standard deviation of a number."""
    if row.cells.get("sigma"):
        return _positive(row, "sigma")
    if row.cells.get("length_km"):
        return (1.0 if sigma is None else sigma) * np.sqrt(_positive(row, "length_km"))
    if sigma is not None:
        return sigma
    raise row.error(
        "sigma",
        found="nothing",
        expected="the standard deviation of each measurement, length_km of a line of "
        "levelling, or --sigma",
    )


def _root_of_vector(row: Row, sigma: float | None) -> Float[np.ndarray, "3 3"]:
    """The Cholesky factor of the covariance matrix of a vector."""
    if any(row.cells.get(column) for column in SIGMAS):
        deviations = np.array([_positive(row, column) for column in SIGMAS])
    else:
        deviations = np.full(3, _sigma(row, sigma))
    matrix = np.diag(deviations**2)
    for column, (i, j) in zip(COVARIANCES, ((1, 0), (2, 0), (2, 1)), strict=True):
        if row.cells.get(column):
            matrix[i, j] = matrix[j, i] = _number(row, column)
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise row.error(
            COVARIANCES[0],
            found="a covariance matrix that is not positive",
            expected="covariances smaller than the products of the standard deviations",
        ) from None


def _number(row: Row, column: str) -> float:
    if column not in row.cells:
        raise TableError(
            row.file, column=column, found="no such column", expected=str(NETWORK)
        )
    return fields.number(row.cells[column], row.file, row.line, column)


def _positive(row: Row, column: str) -> float:
    value = _number(row, column)
    if value <= 0:
        raise row.error(
            column, found=repr(row.cells[column]), expected="a number above 0"
        )
    return value
