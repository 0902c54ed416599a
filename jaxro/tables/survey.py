"""Tables of a survey over a grid: CSV text in, a named `grid_survey.Survey` out, or one
clear error. All in mm.

readings   point, square, parallax; optionally grid (the grid read at the point),
           x, y (for the picture), height (where it is known)
grid       square, side, photo_side; parallax (the grid read in the square, unless
           each reading has its own), height (of the grid there, else 0)
traverses  traverse, from, to, back, fore: the legs in order, both readings made anew
           for each; a square's name is its corner, of known height
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..surveys.grid_survey import Measured, Survey, survey
from ..surveys.networks import unconnected_points
from ..surveys.planning import Deviations
from . import fields
from .fields import Columns, TableError

TEXTS = ("point", "square", "traverse", "from", "to")
POSITIVE = ("side", "photo_side")
READINGS = Columns(("point", "square", "parallax"), ("grid", "x", "y", "height"))
GRID = Columns(("square", "side", "photo_side"), ("parallax", "height"))
TRAVERSES = Columns(("traverse", "from", "to", "back", "fore"))
FOCAL = (3.0, 2000.0)
"""mm: what H l / L, the focal length, may be; outside it some length has another
unit."""
LONGEST = 1e9
"""mm: no length is longer, and none shorter than its inverse."""
SCALE = 1.5
"""Factor by which squares of one photo may differ in scale."""


class Row(NamedTuple):
    """One line: its number, and what stands in each column (None where an optional
    field is empty)."""

    line: int
    cells: dict[str, Any]


@dataclass(frozen=True)
class Named:
    """A survey with the names of its parts; the first `points` of its points are those
    of the table of readings, the others corners of squares. `places`: x, y (2, point),
    None without them."""

    survey: Survey
    names: list[str]
    squares: list[str]
    points: int
    traverses: list[str]
    places: np.ndarray | None


def rows(text: str, file: str, columns: Columns) -> list[Row]:
    """The lines of CSV text by the names of its columns. Raises TableError."""
    found, line = [], 1
    for line, entries in fields.lines_of(io.StringIO(text, newline=""), file, columns):
        cells = {
            c: _cell(entry, file, line, c, c in columns.optional)
            for c, entry in entries.items()
        }
        found.append(Row(line, cells))
    if not found:
        raise TableError(
            file,
            line=line + 1,
            found="no lines",
            expected=f"{columns}, and one line for each below them",
        )
    return found


def _cell(entry: str, file: str, line: int, column: str, optional: bool) -> Any:
    if column in TEXTS:
        return fields.name(entry, file, line, column)
    if optional and not entry:
        return None
    value = fields.number(entry, file, line, column)
    if column in POSITIVE and value <= 0:
        raise TableError(
            file,
            line=line,
            column=column,
            found=repr(entry),
            expected="a positive length in mm",
        )
    if abs(value) > LONGEST:
        raise TableError(
            file,
            line=line,
            column=column,
            found=repr(entry),
            expected=f"mm, at most {LONGEST:g}",
        )
    return value


def read(path: Path, columns: Columns) -> tuple[str, list[Row]]:
    """The name of a file and its lines. Raises TableError."""
    return str(path), rows(fields.read_text(path), str(path), columns)


Table = tuple[str, list[Row]]


def assembled(
    readings: Table,
    grid: Table,
    traverses: Table | None,
    camera_height: float,
    base: float,
    deviations: Deviations,
) -> Named:
    """The survey of these tables. Raises TableError for whatever does not fit
    together."""
    squares = _numbered(*grid, "square")
    points = _numbered(*readings, "point")
    for name, number in points.items():
        if name in squares:
            expected = (
                "a name that no square has: a square's name is that of its corner"
            )
            raise TableError(
                readings[0],
                line=readings[1][number].line,
                column="point",
                found=repr(name),
                expected=expected,
            )
    _check_scale(*grid, camera_height)
    side, photo_side = (np.array([row.cells[c] for row in grid[1]]) for c in POSITIVE)
    datum = np.array([row.cells.get("height") or 0.0 for row in grid[1]])
    square, at_grid, parallax = [], _GridReadings(), []
    p_c = base * photo_side / side
    for row in readings[1]:
        name = row.cells["square"]
        if name not in squares:
            raise TableError(
                readings[0],
                line=row.line,
                column="square",
                found=repr(name),
                expected=f"a square of {grid[0]}",
            )
        k = squares[name]
        own, there = row.cells.get("grid"), grid[1][k].cells.get("parallax")
        if own is None and there is None:
            expected = (
                "the grid read at the point, or a column parallax with that of square "
                f"{name!r} in {grid[0]}"
            )
            raise TableError(
                readings[0],
                line=row.line,
                column="grid",
                found="no reading of the grid",
                expected=expected,
            )
        square.append(k)
        at_grid.add(
            own if own is not None else there,
            None if own is not None else k,
            deviations.grid,
        )
        over = camera_height - datum[k]
        _check_reading(readings[0], row, "parallax", at_grid.of(-1), p_c[k], over)
        parallax.append(row.cells["parallax"])
        known_height = row.cells.get("height")
        if known_height is not None and not -over < known_height - datum[k] < over / 2:
            expected = (
                "a height from the zero of the grid and of the camera height, "
                f"{camera_height:g}"
            )
            raise TableError(
                readings[0],
                line=row.line,
                column="height",
                found=repr(known_height),
                expected=expected,
            )
    height = [row.cells.get("height") for row in readings[1]]
    names, count = list(points), len(points)
    start, end, legs = [], [], [] if traverses is None else traverses[1]
    for row in legs:
        for column, reading, into in (("from", "back", start), ("to", "fore", end)):
            name = row.cells[column]
            if name not in points:
                if name not in squares:
                    expected = (
                        f"a point of {readings[0]}, or a square of {grid[0]} for its "
                        "corner"
                    )
                    file = traverses[0]  # pyright: ignore[reportOptionalSubscript]
                    raise TableError(
                        file,
                        line=row.line,
                        column=column,
                        found=repr(name),
                        expected=expected,
                    )
                points[name] = len(names)
                names.append(name)
                corner = squares[name]
                there = grid[1][corner].cells.get("parallax")
                if there is None:  # the corner is the grid, and this its reading
                    at_grid.add(row.cells[reading], None, 0.0)
                else:
                    at_grid.add(there, corner, deviations.grid)
                square.append(corner)
                parallax.append(at_grid.of(-1))
                height.append(datum[corner])
            i = points[name]
            _check_reading(
                traverses[0],  # pyright: ignore[reportOptionalSubscript]
                row,
                reading,
                at_grid.of(i),
                float(p_c[square[i]]),
                float(camera_height - datum[square[i]]),
            )
            into.append(i)
    known = np.array([h is not None for h in height])
    if traverses is not None:
        _check_legs(traverses, start, end, known, names)
    back, fore = (
        np.array([row.cells[c] for row in legs], float) for c in ("back", "fore")
    )
    values = camera_height, base, side, photo_side, at_grid.values, parallax, back, fore
    point = np.where(np.arange(len(names)) < count, deviations.point, 0.0)
    d, read = deviations, deviations.point
    spread = (
        d.camera_height,
        d.base,
        d.side,
        d.photo_side,
        at_grid.deviations,
        point,
        read,
        read,
    )
    made = survey(
        Measured(*map(jnp.asarray, values)),
        Measured(*map(jnp.asarray, spread)),
        square=square,
        grid=at_grid.number,
        datum=datum,
        known=known,
        height=np.array([h or 0.0 for h in height]),
        start=start,
        end=end,
    )
    places = [[row.cells.get(axis) for row in readings[1]] for axis in "xy"]
    whole = not any(value is None for axis in places for value in axis)
    return Named(
        made,
        names,
        list(squares),
        count,
        [row.cells["traverse"] for row in legs],
        np.array(places, float) if whole else None,
    )


class _GridReadings:
    """Readings of the grid, each once: values and deviations, and the number of that of
    every point."""

    def __init__(self):
        self.values: list[float] = []
        self.deviations: list[Any] = []
        self.number: list[int] = []
        self._shared: dict[int, int] = {}

    def add(self, value: Any, square: int | None, deviation: Any) -> None:
        """The next point has this reading: its own, or (`square`) that of all points of
        the square."""
        if square not in self._shared:
            self.values.append(value)
            self.deviations.append(deviation)
            if square is None:
                self.number.append(len(self.values) - 1)
                return
            self._shared[square] = len(self.values) - 1
        self.number.append(self._shared[square])

    def of(self, point: int) -> float:
        """The reading of the grid that belongs to a point."""
        return self.values[self.number[point]]


def _numbered(file: str, table: list[Row], column: str) -> dict[str, int]:
    """The numbers of the lines by their names, each of which may stand once."""
    numbers: dict[str, int] = {}
    for row in table:
        name = row.cells[column]
        if name in numbers:
            found = (
                f"{name!r} a second time (first on line {table[numbers[name]].line})"
            )
            raise TableError(
                file,
                line=row.line,
                column=column,
                found=found,
                expected=f"each {column} once; of repeated readings give the mean",
            )
        numbers[name] = len(numbers)
    return numbers


def _check_scale(file: str, grid: list[Row], camera_height: float) -> None:
    """All squares below the cameras, and in the scales of one camera."""
    focal = []
    for row in grid:
        datum = row.cells.get("height") or 0.0
        if datum >= camera_height:
            expected = (
                f"less than the camera height of {camera_height:g}, which counts from "
                "the same zero"
            )
            raise TableError(
                file,
                line=row.line,
                column="height",
                found=repr(datum),
                expected=expected,
            )
        focal.append(
            row.cells["photo_side"] / row.cells["side"] * (camera_height - datum)
        )
    usual = float(np.median(focal))
    for row, one in zip(grid, focal, strict=True):
        if not usual / SCALE < one < usual * SCALE:
            found = f"{row.cells['photo_side']!r}, so a focal length of {one:.4g} mm"
            raise TableError(
                file,
                line=row.line,
                column="photo_side",
                found=found,
                expected=f"that of the other squares, {usual:.4g} mm",
            )
    if not FOCAL[0] < usual < FOCAL[1]:
        found = f"squares of a photo with a focal length of {usual:.4g} mm"
        expected = (
            "side, photo_side, --camera-height all in mm, heights and --camera-height "
            "from one zero"
        )
        raise TableError(file, column="photo_side", found=found, expected=expected)


def _check_reading(
    file: str, row: Row, column: str, grid: float, p_c: float, camera_height: float
) -> None:
    """A point between half the camera height over the grid and the whole below it."""
    reading = row.cells[column]
    dp = reading - grid
    if reading == 0 and abs(dp) > p_c / 2:
        raise TableError(
            file,
            line=row.line,
            column=column,
            found="a reading of 0",
            expected="the reading of the point; delete the line without",
        )
    if p_c + dp <= 0:
        found = (
            f"{reading!r}, {-dp:.4g} mm less than the grid's {grid!r}: no point has "
            f"the parallax {p_c + dp:.4g}"
        )
    elif not -camera_height < camera_height * dp / (p_c + dp) < camera_height / 2:
        h = camera_height * dp / (p_c + dp)
        found = (
            f"{reading!r} where the grid has {grid!r}: a point {abs(h):.4g} mm "
            f"{'over' if h > 0 else 'below'} it"
        )
    else:
        return
    raise TableError(
        file,
        line=row.line,
        column=column,
        found=found,
        expected="a reading in mm, from the same zero as those of the grid",
    )


def _check_legs(
    table: Table, start: list[int], end: list[int], known: np.ndarray, names: list[str]
) -> None:
    """Legs that lead somewhere, one behind the other, from points of known height."""
    file, legs = table
    last: dict[str, str] = {}
    for row, a, b in zip(legs, start, end, strict=True):
        if a == b:
            raise TableError(
                file,
                line=row.line,
                column="to",
                found=repr(names[b]),
                expected="another point than the leg comes from",
            )
        name = row.cells["traverse"]
        if last.get(name, names[a]) != names[a]:
            found, expected = (
                repr(names[a]),
                f"{last[name]!r}, where the leg before it of traverse {name!r} ends",
            )
            raise TableError(
                file, line=row.line, column="from", found=found, expected=expected
            )
        last[name] = names[b]
    used = np.unique([start, end])
    lost = set(
        used[
            unconnected_points(
                np.searchsorted(used, start), np.searchsorted(used, end), known[used]
            )
        ].tolist()
    )
    for row, a in zip(legs, start, strict=True):
        if a in lost:
            found = f"{names[a]!r}, which no legs join to a known height"
            raise TableError(
                file,
                line=row.line,
                column="from",
                found=found,
                expected="a corner of the grid, or a point with a known height",
            )
    if known[used].all():
        raise TableError(
            file,
            line=legs[0].line,
            found="legs between known heights alone",
            expected="points whose heights are sought",
        )
