"""Tables of measured image coordinates: CSV text in, a `Table` of columns out, or one
clear error.

Columns, in any order: point, x_left, y_left, x_right, y_right and optionally pair, left
and right (the names of the photos), sigma; `id,xl,yl,xr,yr` is the short form of the
first five. In place of sigma there may be a standard deviation for each coordinate,
sigma_x_left, sigma_y_left, sigma_x_right, sigma_y_right, and the covariances of x and y
in each photo, cov_xy_left and cov_xy_right. All are in the units of the measurement
(covariances in their square); cameras turn them into photo coordinates. Nothing is
skipped or guessed: whatever does not fit stops the reading with file, line and column.

The table that `jaxro clean` writes, cleaned.csv, has the column verdict beside these:
rejected points are left out.
"""

import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from . import fields
from .fields import TableError, read_text
from .measured import (
    COLUMNS,
    COVARIANCES,
    DEVIATIONS,
    NUMBERS,
    PHOTOS,
    VERDICTS,
    Measurements,
    Table,
    check_accuracy,
    of_pairs,
)


class Line(NamedTuple):
    """One line of a table: its number, pair, point, the numbers of `NUMBERS` that the
    table has, the photos of the pair, () where it has none, the names of the numbers,
    and whether the point was not rejected by an earlier cleaning."""

    number: int
    pair: str
    point: str
    values: tuple[float, ...]
    photos: tuple[str, ...]
    columns: tuple[str, ...]
    kept: bool


def read(path: Path) -> Table:
    """The pairs of a CSV file; without a column `pair` one pair, named after the file.
    Raises TableError."""
    return parse(read_text(path), str(path), path.stem)


def parse(text: str, file: str, name: str) -> Table:
    """The pairs of CSV text. `file` is named in errors, `name` is the pair's where the
    table has no column `pair`."""
    line, rejected = 1, 0
    pairs: dict[str, Measurements] = {}
    seen: dict[str, dict[str, int]] = {}
    places: dict[tuple, str] = {}
    twins: dict[str, list[str]] = {}
    for line, pair, point, values, photos, columns, kept in check_lines(
        io.StringIO(text, newline=""), file, name
    ):
        if not kept:
            rejected += 1
            continue
        first = seen.setdefault(pair, {}).setdefault(point, line)
        if first != line:
            found = f"{point!r} a second time in pair {pair!r} (first on line {first})"
            raise TableError(
                file,
                line=line,
                column="point",
                found=found,
                expected="each point once in a pair; rename it or delete one of the two",
            )
        twin = places.setdefault((pair, *values[:4]), point)
        if twin != point:
            twins.setdefault(pair, []).append(f"{point} = {twin} (line {line})")
        new = Measurements(pair, photos=photos, numbers=columns)
        measured = pairs.setdefault(pair, new)
        if measured.photos != photos:
            raise TableError(
                file,
                line=line,
                column="left",
                found=f"the photos {' and '.join(photos)}, and on line "
                f"{measured.lines[0]} {' and '.join(measured.photos)} for the same pair "
                f"{pair!r}",
                expected="the same two photos in all lines of a pair",
            )
        measured.points.append(point)
        measured.rows.append(values)
        measured.lines.append(line)
    if not pairs:
        raise no_points(file, line)
    warnings = [_twins(file, pair, found) for pair, found in twins.items()]
    if rejected:
        points = "1 point is" if rejected == 1 else f"{rejected} points are"
        warnings.append(f"{file}: {points} left out, which the column verdict rejects.")
    return of_pairs(list(pairs.values()), file, warnings)


def no_points(file: str, line: int) -> TableError:
    """There is nothing below this line."""
    return TableError(
        file,
        line=line + 1,
        found="no points",
        expected="one line for every measured point below the header",
    )


def lines(path: Path) -> Iterator[Line]:
    """The `check_lines` lines of a file, one at a time. Raises TableError."""
    text = fields.text_lines(path)
    yield from check_lines(text, str(path))


def check_lines(text: Iterable[str], file: str, name: str = "") -> Iterator[Line]:
    """Every line below the header, each field looked at; `name`: of the pair, where the
    table has neither a column for it nor for its photos. Raises TableError."""
    columns: tuple[str, ...] = ()
    for line, cells in fields.lines_of(text, file, COLUMNS):
        if not columns:
            check_accuracy(tuple(cells), file)
            columns = tuple(name for name in NUMBERS if name in cells)
        point = fields.name(cells["point"], file, line, "point")
        photos = _photos(cells, file, line)
        pair = "-".join(photos) or name
        if "pair" in cells:
            pair = fields.name(cells["pair"], file, line, "pair")
        values = tuple(_number(cells[c], file, line, c) for c in columns)
        _check_covariances(dict(zip(columns, values, strict=True)), file, line)
        kept = "verdict" not in cells or _is_kept(cells["verdict"], file, line)
        yield Line(line, pair, point, values, photos, columns, kept)


def _photos(cells: dict[str, str], file: str, line: int) -> tuple[str, ...]:
    """The names of the left and the right photo. Raises TableError."""
    there = [column for column in PHOTOS if column in cells]
    if not there:
        return ()
    if len(there) == 1:
        missing = next(column for column in PHOTOS if column not in there)
        raise TableError(
            file,
            column=missing,
            found=f"no such column beside {there[0]}",
            expected="left and right, the names of both photos of each pair",
        )
    left, right = (fields.name(cells[c], file, line, c) for c in PHOTOS)
    if left == right:
        raise TableError(
            file,
            line=line,
            column="right",
            found=f"{right!r}, as in column left",
            expected="two photos in each pair",
        )
    return left, right


def _is_kept(verdict: str, file: str, line: int) -> bool:
    """Whether an earlier cleaning did not reject the point. Raises TableError."""
    if verdict not in VERDICTS.values():
        raise TableError(
            file,
            line=line,
            column="verdict",
            found=repr(verdict),
            expected=f"one of {', '.join(VERDICTS.values())}",
        )
    return verdict != VERDICTS[0]


def _twins(file: str, pair: str, found: list[str]) -> str:
    named = ", ".join(found[:5]) + (
        f" and {len(found) - 5} more" if len(found) > 5 else ""
    )
    return (
        f"{file}: in pair {pair!r} the coordinates of a point occur again under "
        f"another name: {named}. "
        "Each counts in the degrees of freedom; delete what was measured only once."
    )


def _number(text: str, file: str, line: int, column: str) -> float:
    """A finite number; positive for a standard deviation."""
    value = fields.number(
        text, file, line, column, "; delete the line to leave the point out"
    )
    if column in ("sigma", *DEVIATIONS) and value <= 0:
        raise TableError(
            file,
            line=line,
            column=column,
            found=repr(text),
            expected="a positive standard deviation in the unit of the coordinates",
        )
    return value


def _check_covariances(values: dict[str, float], file: str, line: int) -> None:
    """Raises TableError for a covariance that the two standard deviations rule out."""
    for side, column in enumerate(COVARIANCES):
        if column in values:
            x, y = (values[name] for name in DEVIATIONS[2 * side :][:2])
            if abs(values[column]) >= x * y:
                raise TableError(
                    file,
                    line=line,
                    column=column,
                    found=f"{values[column]:g}",
                    expected="a covariance that is smaller in size than the product of "
                    f"the two standard deviations, {x * y:g}",
                )
