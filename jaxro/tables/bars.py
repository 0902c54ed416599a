"""Tables of scale bars: CSV text in, `block.Bars` out, or one clear error.

from, to      the points at the ends
length        between them, in the unit of the ground
sigma         its standard deviation; not needed where one is given for all
"""

import io
from pathlib import Path

import numpy as np

from ..block.bars import Bars, bars
from . import fields
from .fields import Columns, TableError
from .survey_checks import Row

BARS = Columns(("from", "to", "length"), ("sigma",), texts=("from", "to"))


def read(path: Path, sigma: float | None) -> Bars:
    """The bars of a file; `sigma`: of all lengths where the table has no column of it.
    Raises TableError."""
    return parse(fields.read_text(path), str(path), sigma)


def parse(text: str, file: str, sigma: float | None) -> Bars:
    """The bars of CSV text. Raises TableError."""
    rows, line = [], 1
    given = io.StringIO(text, newline="")
    for line, cells in fields.lines_of(given, file, BARS):
        row = Row(file, line, dict(cells))
        ends = [fields.name(cells[c], file, line, c) for c in ("from", "to")]
        if ends[0] == ends[1]:
            raise row.error(
                "to", found=repr(ends[1]), expected="another point than in column from"
            )
        if sigma is None and "sigma" not in cells:
            raise TableError(
                file,
                column="sigma",
                found="no such column",
                expected="the standard deviation of each length, or --control-sigma",
            )
        length = _positive(row, "length")
        own = _positive(row, "sigma") if "sigma" in cells else sigma
        rows.append((*ends, length, own))
    if not rows:
        raise TableError(
            file, line=line + 1, found="no bars", expected=f"{BARS}, and one line a bar"
        )
    one, other, lengths, deviations = zip(*rows, strict=True)
    return bars(one, other, np.array(lengths), np.array(deviations))


def _positive(row: Row, column: str) -> float:
    value = fields.number(row.cells[column], row.file, row.line, column)
    if value <= 0:
        raise row.error(
            column, found=repr(row.cells[column]), expected="a number above 0"
        )
    return value
