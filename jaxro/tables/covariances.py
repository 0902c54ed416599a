"""Tables of covariances between the known coordinates of points: CSV text in, entries
out, or one clear error.

point, other    two points, or the same twice
cXX ... cZZ     the covariance of the coordinate of `point` (first letter) and that of
                `other`; variances are those of the table of points
"""

import io
from pathlib import Path
from typing import NamedTuple

from . import fields
from .fields import Columns
from .survey_checks import Row

AXES = "xyz"
COVARIANCES = Columns(
    ("point", "other"),
    tuple(f"c{a}{b}" for a in AXES for b in AXES),
    texts=("point", "other"),
)

Coordinate = tuple[str, int]
"""A point and its axis."""


class Covariance(NamedTuple):
    """The covariance of two coordinates, and where it stands."""

    one: Coordinate
    other: Coordinate
    value: float
    row: Row


def read(path: Path) -> list[Covariance]:
    """The entries of a file. Raises TableError."""
    found: list[Covariance] = []
    first: dict[frozenset[Coordinate], int] = {}
    given = io.StringIO(fields.read_text(path), newline="")
    for line, cells in fields.lines_of(given, str(path), COVARIANCES):
        row = Row(str(path), line, dict(cells))
        names = [
            fields.name(row.cells[column], row.file, line, column)
            for column in ("point", "other")
        ]
        for i, a in enumerate(AXES):
            for j, b in enumerate(AXES):
                column = f"c{a}{b}"
                if not row.cells.get(column):
                    continue
                one, other = (names[0], i), (names[1], j)
                both = frozenset((one, other))
                if len(both) == 1:
                    raise row.error(
                        column,
                        found="the variance of a coordinate",
                        expected="it as deviation in the table of points",
                    )
                if both in first:
                    raise row.error(
                        column,
                        found=f"this covariance again (first on line {first[both]})",
                        expected="each once",
                    )
                first[both] = line
                value = fields.number(row.cells[column], row.file, line, column)
                found.append(Covariance(one, other, value, row))
    return found
